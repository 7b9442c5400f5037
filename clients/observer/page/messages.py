"""What the page is sent as server-sent events, beside the wire's own replies.

The events by name: `snapshot` and `page` (a `StatusReply`, whose leases come in pages), `waits`,
`usage`, `history` (a `HistoryReply`). All are written by `schemas.codec`.
"""

from dataclasses import dataclass
from typing import NamedTuple

from vram_arbiter.schemas.wire.explained import Explanation


@dataclass(frozen=True, slots=True)
class WaitsMessage:
    """Why the first requests of the queues wait."""

    waits: tuple[Explanation, ...]


PENDING_FREE, RETAINED, STOWAWAYS, OTHERS = -1, -2, -3, -4
"""Parts of a `UsageSample` that are not a consumer. OTHERS: consumers beyond the largest."""


class UsageSample(NamedTuple):
    """Bytes of one GPU from an instant on, until the next sample of the same GPU."""

    at_s: float  # uptime of the daemon
    gpu: int  # its index
    used_bytes: int | None  # measured; None: unknown
    parts: tuple[tuple[int, int], ...]  # (place in `consumers`, or a code), bytes


@dataclass(frozen=True, slots=True)
class Usage:
    """The last minutes of the GPUs, or what came since the last message."""

    consumers: tuple[str, ...]
    samples: tuple[UsageSample, ...]
    kept_s: float  # how far back they may reach
