"""The configuration as the parts of the daemon take it: the engine, the sessions, the router."""

import secrets
from collections.abc import Collection, Sequence
from dataclasses import fields
from pathlib import Path

from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice
from vram_arbiter.arbiter.host.gpu.unified import read_meminfo
from vram_arbiter.arbiter.host.journal import Opened
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.schemas.config.arbiter import ArbiterConfig
from vram_arbiter.schemas.errors import ConfigError, ProbeFailed
from vram_arbiter.schemas.runtime.connection import Bounds
from vram_arbiter.schemas.units import format_bytes

DESCRIPTOR_RESERVE = 192
"""For the daemon's own files: journal, history, event log, readings."""
TOKEN_SECRET_BYTES = 16
PARK_SHARE = 2
"""Of the host RAM that is available at start, one part in so many may keep parked weights."""


def budget(
    gpus: Sequence[GpuDevice], config: ArbiterConfig, source: str = ""
) -> tuple[GpuInfo, ...]:
    """What of each GPU is leased out. Raises ConfigError for a cap on a GPU that is not there, or
    a reserve larger than a GPU."""
    caps = dict(config.gpu.capacity_bytes)
    found = []
    for gpu in gpus:
        by_id, by_index = caps.pop(gpu.id, None), caps.pop(str(gpu.index), None)
        capacity = min(size for size in (gpu.total_bytes, by_id, by_index) if size is not None)
        reserve = max(config.gpu.reserve_bytes, gpu.margin_bytes)
        if capacity <= reserve:
            raise ConfigError(
                f"gpu.reserve_bytes ({format_bytes(reserve)}) leaves nothing of {gpu.name} "
                f"({format_bytes(capacity)})",
                hint="lower the reserve, or raise the cap",
            )
        found.append(
            GpuInfo(
                id=gpu.id,
                index=gpu.index,
                name=gpu.name,
                capacity_bytes=capacity,
                reserve_bytes=reserve,
                source=source,
                noise_bytes=gpu.noise_bytes,
                total_bytes=gpu.total_bytes,
            )
        )
    if caps:
        known = ", ".join(f"{gpu.index} ({gpu.id})" for gpu in gpus)
        raise ConfigError(
            f"gpu.capacity_bytes names no GPU of this machine: {', '.join(caps)}",
            hint=f"GPUs: {known}",
        )
    return tuple(found)


def core_settings(config: ArbiterConfig, gpus: tuple[GpuInfo, ...], opened: Opened) -> Settings:
    """Constants of the engine, with what the journal remembers."""
    noise_bytes = max(gpu.noise_bytes for gpu in gpus)
    return _filled(
        Settings,
        config,
        epoch=opened.epoch,
        gpus=gpus,
        learnt=dict(opened.learnt),
        footprints=dict(opened.footprints),
        verify_tolerance_bytes=max(config.verify.tolerance_bytes, noise_bytes),
        token_secret=secrets.token_hex(TOKEN_SECRET_BYTES),
        host_ram_budget_bytes=park_budget_bytes(config.host.park_budget_bytes),
    )


def park_budget_bytes(configured: int | None, root: Path = Path("/")) -> int:
    """The budget for parked weights: the operator's, else a share of what is available; where that
    is unknown, nothing."""
    if configured is not None:
        return configured
    try:
        _, available = read_meminfo(root)
    except ProbeFailed:
        return 0
    return available // PARK_SHARE


def router_limits(config: ArbiterConfig, open_files: int) -> Bounds:
    """A connection may take three descriptors: its socket, and two pidfds if it is the only one of
    its process."""
    room = max(4, (open_files - DESCRIPTOR_RESERVE) // 3)
    return _filled(
        Bounds,
        config,
        connections_max=min(config.limits.connections_max, room),
        descriptor_reserve=DESCRIPTOR_RESERVE,
    )


def core_changes(config: ArbiterConfig, keys: Collection[str]) -> dict[str, float]:
    """Return the engine's constants among changed keys (`section.key`), by their names there."""
    names = {field.name for field in fields(Settings)}
    found: dict[str, float] = {}
    for section, _, key in (path.partition(".") for path in keys):
        value = getattr(getattr(config, section), key)
        found.update({name: value for name in (key, f"{section}_{key}") if name in names})
    return found


def session_settings(config: ArbiterConfig, **given: object) -> SessionSettings:
    """Constants of the sessions; `given` are those that the configuration does not have."""
    return _filled(SessionSettings, config, **given)


def _filled[T](cls: type[T], config: ArbiterConfig, **given: object) -> T:
    """Fill a class of constants: a value of the configuration belongs to the field that has its
    key's name, or its section's and its key's."""
    names = {field.name for field in fields(cls)}  # type: ignore[arg-type]  # a dataclass
    values = {
        name: value
        for section, keys in config
        for key, value in keys
        for name in (key, f"{section}_{key}")
        if name in names
    }
    return cls(**{**values, **given})
