"""What the engine is told at its construction: GPUs and constants."""

from dataclasses import dataclass, field

from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId


@dataclass(frozen=True, slots=True)
class GpuInfo:
    """One GPU. `capacity_bytes`: all that it has, or less if an operator caps it."""

    id: GpuId
    index: int
    name: str
    capacity_bytes: int
    reserve_bytes: int = d.RESERVE_BYTES
    source: str = ""  # what reads it: nvml, unified, drm, fake
    noise_bytes: int = 0  # by how much its readings move when nothing happens
    total_bytes: int = 0  # what its readings call all of it; 0: not known before the first one


@dataclass(frozen=True, slots=True)
class Settings:
    """Constants of the engine. Seconds are monotonic, sizes are bytes."""

    epoch: int
    gpus: tuple[GpuInfo, ...]
    ageing_s_per_point: float = d.AGEING_S_PER_POINT
    revoke_resend_s: float = d.REVOKE_RESEND_S
    revoke_remind_s: float = d.REVOKE_REMIND_S
    revoke_deadline_s: float = d.REVOKE_DEADLINE_S
    thrash_window_s: float = d.THRASH_WINDOW_S
    thrash_hold_max_s: float = d.THRASH_HOLD_MAX_S
    verify_timeout_s: float = d.VERIFY_TIMEOUT_S
    verify_poll_s: tuple[float, ...] = d.VERIFY_POLL_S
    verify_poll_until_s: tuple[float, ...] = d.VERIFY_POLL_UNTIL_S
    verify_confirm_s: float = d.VERIFY_CONFIRM_S
    verify_slow_poll_s: float = d.VERIFY_SLOW_POLL_S
    verify_tolerance_bytes: int = d.VERIFY_TOLERANCE_BYTES
    sample_max_age_s: float = d.SAMPLE_MAX_AGE_S
    probe_period_s: float = d.PROBE_PERIOD_S
    probe_load_s: float = d.LOAD_PROBE_S
    fence_grace_s: float = d.FENCE_GRACE_S
    waiters_max: int = d.WAITERS_MAX
    leases_per_client_max: int = d.LEASES_PER_CLIENT_MAX
    uses_per_lease_max: int = d.USES_PER_LEASE_MAX
    process_share: float = d.PROCESS_SHARE
    user_share: float = d.USER_SHARE
    priority_reserve: float = d.PRIORITY_RESERVE
    token_secret: str = ""
    """Secret hexadecimal digits that keep tokens from being guessed. "": the next number
    each time."""
    host_ram_budget_bytes: int = 0
    """Host RAM for the weights of parked leases; 0: no parking."""
    learnt: dict[str, dict[str, float]] = field(default_factory=dict)
    """Durations learned by earlier runs, per consumer: {"drain_s", "unload_s", "verify_s",
    "load_s"}."""
    footprints: dict[str, dict[str, list[int]]] = field(default_factory=dict)
    """Footprints measured by earlier runs, as `Footprints.kept` gave them."""
