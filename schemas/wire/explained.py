"""Answers to *why is this consumer not running*. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal


@dataclass(frozen=True, slots=True)
class Blocker:
    """A lease or process with bytes that the waiter lacks, and the condition on which they come free."""

    lease_id: str | None  # None: a process without a resident lease
    consumer: str
    bytes: int
    state: str
    uses: int
    condition: str


@dataclass(frozen=True, slots=True)
class Step:
    """What the arbiter does next for a waiter. `in_s` None: no instant is planned."""

    action: str
    consumer: str
    lease_id: str | None
    in_s: float | None
    text: str


@dataclass(frozen=True, slots=True)
class FootprintView:
    """Declared against learned bytes, by part. Learned 0: never measured."""

    declared_bytes: Mapping[str, int]
    learnt_bytes: Mapping[str, int]
    held_bytes: int | None


@dataclass(frozen=True, slots=True)
class Explanation:
    """One lease: what it needs, what is in its way, what happens next and when."""

    lease_id: str
    state: str
    position: int
    needed_bytes: int
    free_bytes: int
    deficit_bytes: int
    condition: str
    blockers: tuple[Blocker, ...]
    next: str
    eta_s: float | None
    eta_source: Literal["learnt", "none"]
    footprint: FootprintView
    text: str
    plan: tuple[Step, ...] = ()


@dataclass(frozen=True, slots=True)
class WhyReply:
    """One entry per live lease of the consumer, the oldest first."""

    consumer: str
    leases: tuple[Explanation, ...]
    more: int = 0  # leases of that consumer beside those that are explained
