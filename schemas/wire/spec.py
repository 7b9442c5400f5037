"""What a lease is to be and what it puts on a GPU, written down once: requests, engine, journal,
event log and clients share these records. Standard library only."""

from dataclasses import dataclass
from typing import Annotated, ClassVar, Final, Literal

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.limits import Bytes, Limits, Name, Seconds

_STRICT: Final = {"extra": "forbid"}


@dataclass(frozen=True, slots=True)
class Footprint:
    """Bytes that a model puts on a GPU: at the worst moment of loading, when resident, and after
    unloading while its process lives."""

    __pydantic_config__: ClassVar = _STRICT

    load_peak_bytes: Bytes
    steady_bytes: Bytes
    residue_bytes: Bytes = d.RESIDUE_BYTES


@dataclass(frozen=True, slots=True)
class Gang:
    """Several leases, of whatever processes, that are granted together or not at all. One id for
    each time."""

    __pydantic_config__: ClassVar = _STRICT

    id: Name
    size: Annotated[int, Limits(ge=2, le=16)]


@dataclass(frozen=True, slots=True)
class LeaseSpec:
    """What a lease is to be. `evictable=False` pins it: it is never evicted."""

    __pydantic_config__: ClassVar = _STRICT

    consumer: Name
    model_id: Name
    footprint: Footprint
    revision: Annotated[str, Limits(max_length=d.NAME_MAX_CHARS)] = ""
    gpu: Name = "any"  # uuid, index or `any`
    mode: Literal["exclusive", "shared"] = "shared"
    priority: Annotated[int, Limits(ge=0, le=d.PRIORITY_MAX)] = d.PRIORITY
    evictable: bool = True
    ttl_s: Annotated[float, Limits(ge=0.5, le=3600)] = d.LEASE_TTL_S
    min_residency_s: Seconds = d.MIN_RESIDENCY_S
    # what a waiter gets when a holder outstays the ladder's deadline
    on_deadline: Literal["wait", "deny"] = "wait"
    # what may be done to its own process if that outstays the deadline idle
    on_overstay: Literal["wait", "terminate", "kill"] = "wait"
    standby: bool = False  # asked to leave, it comes back by itself when there is room
    park_bytes: Bytes = 0  # host RAM that keeps its weights while it is away; 0: not parked
    gang: Gang | None = None
    # the process's own uses do not wait for this lease (a prefetch): no deadlock is seen in it
    independent: bool = False

    @property
    def model(self) -> str:
        """Model and revision; the same one can be used again without a reload."""
        return f"{self.model_id}@{self.revision}" if self.revision else self.model_id

    @property
    def exclusive(self) -> bool:
        return self.mode == "exclusive"
