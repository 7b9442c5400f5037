"""Read-only view of the engine's records, for tests and offline tools. No decision reads it."""

from collections.abc import Mapping
from dataclasses import dataclass, fields
from types import MappingProxyType
from typing import Any, Self

from vram_arbiter.arbiter.core.ledger import HostRam
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.learned import Costs, Footprints
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.model.state import Client, Core, Ended, Refusals, Timers
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, UseId


@dataclass(frozen=True, slots=True)
class Inspection:
    """The live tables of the engine: they change with the next event, and cannot be
    changed here."""

    gpus: Mapping[GpuId, Gpu]
    leases: Mapping[LeaseId, Lease]
    waiting: Mapping[LeaseId, Lease]
    away: Mapping[LeaseId, Lease]
    ended: Mapping[LeaseId, Ended]
    nonces: Mapping[tuple[ProcessKey, str], LeaseId]
    clients: Mapping[ClientId, Client]
    users: Mapping[ProcessKey, Mapping[tuple[LeaseId, UseId], Lease]]
    host_ram: HostRam
    costs: Costs
    refusals: Mapping[ProcessKey, Refusals]
    footprints: Footprints
    timers: Timers

    @classmethod
    def of(cls, core: Core) -> Self:
        tables: Any = {field.name: getattr(core, field.name) for field in fields(cls)}
        shown: Any = {
            name: MappingProxyType(table) if isinstance(table, dict) else table
            for name, table in tables.items()
        }
        return cls(**shown)
