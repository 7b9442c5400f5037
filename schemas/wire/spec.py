"""What a lease is to be and what it puts on a GPU, written down once: requests, engine, journal,
event log and clients share these records. Standard library only."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Literal

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.limits import STRICT, Bytes, Limits, Name, Seconds

_PART = r"(\.{0,2}[^/.\x00-\x1f\x7f][^/\x00-\x1f\x7f]*|\.{3}[^/\x00-\x1f\x7f]*)"
Cgroup = Annotated[str, Limits(max_length=1024, pattern=f"^(/{_PART})+$")]
"""Path in the cgroup v2 hierarchy, as /proc/PID/cgroup has it after `0::`: not the root, and
without the parts `.`, `..` and empty ones."""


@dataclass(frozen=True, slots=True)
class Footprint:
    """Bytes that a model puts on a GPU: at the worst moment of loading, when resident, and after
    unloading while its process lives."""

    __pydantic_config__: ClassVar = STRICT

    load_peak_bytes: Bytes
    steady_bytes: Bytes
    residue_bytes: Bytes = d.RESIDUE_BYTES


@dataclass(frozen=True, slots=True)
class LeaseSpec:
    """What a lease is to be. `evictable=False` pins it: it is never evicted."""

    __pydantic_config__: ClassVar = STRICT

    consumer: Name
    model_id: Name
    footprint: Footprint
    revision: Annotated[str, Limits(max_length=d.NAME_MAX_CHARS)] = ""
    gpu: Name = "any"
    """UUID, index, or `any`."""
    mode: Literal["exclusive", "shared"] = "shared"
    priority: Annotated[int, Limits(ge=0, le=d.PRIORITY_MAX)] = d.PRIORITY
    evictable: bool = True
    ttl_s: Annotated[float, Limits(ge=0.5, le=3600)] = d.LEASE_TTL_S
    """Seconds without a renewal after which the lease expires; the client renews by itself."""
    min_residency_s: Seconds = d.MIN_RESIDENCY_S
    """Seconds after the load in which it is not revoked."""
    standby: bool = False
    """Evicted, it returns by itself when there is room."""
    park_bytes: Bytes = 0
    """Host RAM that keeps its weights while it is away; 0: it is not parked."""
    cgroup: Cgroup | None = None
    """The bytes of processes in this cgroup, and below it, are the holder's too: of a systemd unit
    or a container, whose processes are not its descendants. It belongs to the client's user, or
    the client may operate; no other process's lease may name one above, below or the same."""

    @property
    def model(self) -> str:
        """Model and revision; the same one can be used again without a reload."""
        return f"{self.model_id}@{self.revision}" if self.revision else self.model_id

    @property
    def exclusive(self) -> bool:
        return self.mode == "exclusive"
