"""Leases and GPUs as replies, pushes and `status` show them. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass, field

from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.wire.codes import Block


@dataclass(frozen=True, slots=True)
class BlockView:
    """Why nothing is granted on a GPU.

    `names`: holders that have not reattached, or the consumer that loads; `more` are not named.
    `text`: the same in words; the engine leaves it empty.
    """

    code: Block
    names: tuple[str, ...] = ()
    more: int = 0
    problem: str = ""  # of the probe, or the operator's order
    bytes: int = 0  # pressure
    text: str = ""


@dataclass(frozen=True, slots=True)
class LeaseView:
    """A lease. `token` is None while it is queued, and for readers that are neither its holder's
    process nor an operator."""

    lease_id: str
    token: Token | None
    state: str
    consumer: str
    model: str
    gpu: str | None
    mode: str
    priority: int
    evictable: bool
    charge_bytes: int
    uses: int
    pid: int
    since_s: float  # seconds in this state
    waited_s: float = 0.0
    granted_s: float | None = None  # seconds since the grant, also across restarts of the daemon
    position: int | None = None  # in its queue
    ttl_left_s: float | None = None
    pinned: str = ""  # the operator that pinned it, and why
    standby: bool = False  # once evicted, it comes back by itself
    parked_bytes: int | None = None  # host RAM that is booked for it
    drift_bytes: int = 0  # measured less declared, where that is more than the tolerance


@dataclass(frozen=True, slots=True)
class ProcessView:
    """A process with bytes on a GPU."""

    pid: int
    name: str
    used_bytes: int | None  # None: the driver does not say
    lease_ids: tuple[str, ...]
    charged_bytes: int
    residue_bytes: int
    stowaway: bool


@dataclass(frozen=True, slots=True)
class SensorsView:
    """What a GPU tells beside its memory; None: unknown. No decision depends on it."""

    utilization: float | None = None  # share of the last moments in which the GPU was busy
    temperature_c: float | None = None
    power_w: float | None = None  # of the whole board


@dataclass(frozen=True, slots=True)
class GpuView:
    """A GPU: what is charged, what is measured, and why nothing is granted now."""

    gpu: str
    index: int
    name: str
    source: str  # what reads it: nvml, unified, drm, fake
    capacity_bytes: int
    reserve_bytes: int
    charged_bytes: int
    stowaway_bytes: int
    measured_used_bytes: int | None  # None: unknown, blocks grants
    sample_age_s: float | None
    pressure_bytes: int
    blocked: BlockView | None  # None: grants are possible
    processes: tuple[ProcessView, ...]
    sensors: SensorsView = SensorsView()  # of the last 20 s


@dataclass(frozen=True, slots=True)
class Totals:
    """Leases of all pages of a status."""

    leases: int
    waiting: int


@dataclass(frozen=True, slots=True)
class DemandView:
    """Requests at a consumer, with or without a lease, as the client tells that serves it."""

    consumer: str
    in_flight: int
    waiting: int
    client: str


@dataclass(frozen=True, slots=True)
class HostRamView:
    """Host RAM for parked weights."""

    budget_bytes: int
    parked_bytes: int


@dataclass(frozen=True, slots=True)
class DaemonView:
    """The daemon itself: its files, its process, and what it counted since its start."""

    server: str  # name and version
    python: str
    journal_healthy: bool = True
    journal_doubted: bool = False  # it may not name every lease
    config_refused: bool = False  # a changed configuration; the former one is in force
    journal_writes: int = 0  # transactions
    journal_write_s: float = 0.0  # all of them together
    journal_failures: int = 0
    refusals: Mapping[str, int] = field(default_factory=dict)  # requests of any kind, by code
    cpu_user_s: float = 0.0
    cpu_system_s: float = 0.0
    memory_bytes: int = 0
