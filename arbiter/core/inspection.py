"""Read-only view of the engine's records, for tests and offline tools. No decision reads it."""

from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Self

from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.learning.footprints import Footprints
from vram_arbiter.arbiter.core.model.lease import Failures, Lease
from vram_arbiter.arbiter.core.model.state import Client, Core, Ended, Gpu, Refusals, Reuse
from vram_arbiter.arbiter.core.timers import Timers
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, UseId


@dataclass(frozen=True, slots=True)
class Inspection:
    """The live tables of the engine: they change with the next event, and cannot be
    changed here."""

    gpus: Mapping[GpuId, Gpu]
    leases: Mapping[LeaseId, Lease]
    waiting: Mapping[LeaseId, Lease]
    ended: Mapping[LeaseId, Ended]
    nonces: Mapping[tuple[ProcessKey, str], LeaseId]
    clients: Mapping[ClientId, Client]
    users: Mapping[ProcessKey, Mapping[tuple[LeaseId, UseId], Lease]]
    features: tuple[Feature, ...]
    crashes: Mapping[str, Failures]
    reuse: Mapping[str, Reuse]
    switches: Mapping[tuple[str, str], float]
    refusals: Mapping[ProcessKey, Refusals]
    footprints: Footprints
    timers: Timers

    @classmethod
    def of(cls, core: Core) -> Self:
        return cls(
            gpus=MappingProxyType(core.gpus),
            leases=MappingProxyType(core.leases),
            waiting=MappingProxyType(core.waiting),
            ended=MappingProxyType(core.ended),
            nonces=MappingProxyType(core.nonces),
            clients=MappingProxyType(core.clients),
            users=MappingProxyType(core.users),
            features=core.features,
            crashes=MappingProxyType(core.crashes),
            reuse=MappingProxyType(core.reuse),
            switches=MappingProxyType(core.switches),
            refusals=MappingProxyType(core.refusals),
            footprints=core.footprints,
            timers=core.timers,
        )

    def feature[F: Feature](self, kind: type[F]) -> F:
        """Return the feature of a class, with its records."""
        return next(feature for feature in self.features if isinstance(feature, kind))
