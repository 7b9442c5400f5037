"""Workload of a simulation: what consumers want, independent of any decision.

Made from a scenario (`scenarios`) or from a log (`extract`). Times are seconds since the beginning.
Data only.
"""

from dataclasses import dataclass, field

from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.schemas.wire.spec import LeaseSpec


@dataclass(frozen=True, slots=True)
class Job:
    """One piece of work that needs its consumer's model resident."""

    due_s: float
    spec: LeaseSpec
    use_s: float | None  # None: it only holds the bytes and marks no use
    load_s: float
    unload_s: float
    measured_bytes: int | None = None
    settle_s: float = 0.0  # between ready and the beginning of the use
    wait_timeout_s: float | None = None
    release_after_s: float | None = None  # releases so long after this job, if there is no other
    alongside: bool = False  # may begin before the previous one is over


@dataclass(slots=True)
class Plan:
    """One process with one model at a time: its jobs in order of arrival."""

    consumer: str
    jobs: list[Job]
    heed_s: float = 0.0  # between its safe point and its `unloading`
    leaves_s: float | None = None  # its process ends then, but not before its jobs are done
    followers: list["Follower"] = field(default_factory=list)
    resident: bool = False  # its first job's model is loaded when the simulation begins


@dataclass(frozen=True, slots=True)
class Follower:
    """Link to another plan: it gets its next job when one of this plan is over.

    `jobs` holds them, `due_s` is the pause.
    """

    plan: Plan
    jobs: list[Job]


@dataclass(frozen=True, slots=True)
class GpuPlan:
    """One GPU and its behavior."""

    info: GpuInfo
    total_bytes: int
    overhead_bytes: int = 0
    release_lag_s: float = 0.0
    others: tuple[
        tuple[float, str, int], ...
    ] = ()  # (since, name, bytes) of processes without a lease


@dataclass(slots=True)
class Workload:
    """A whole workload."""

    gpus: list[GpuPlan]
    plans: list[Plan]
    seconds: float
    # parts of a log that could not be taken over, in words
    approximations: list[str] = field(default_factory=list)
