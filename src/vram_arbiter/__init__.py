"""VRAM arbiter: a daemon that leases GPU memory, and the programs that hold leases.

    from vram_arbiter import Client

    with Client("detector") as arbiter:
        with arbiter.lease(vram="5.3GB", model="owlv2", unload=free_model) as lease:
            load_model()
            with lease.use("detect"):
                ...

The names below are loaded when they are first used, so that importing a part of the package, such
as `vram_arbiter.schemas`, loads nothing else.
"""

from importlib import import_module
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from vram_arbiter.clients._protocol.records import Eviction
    from vram_arbiter.clients.client import AsyncClient
    from vram_arbiter.clients.handlers import Handlers
    from vram_arbiter.clients.lease import AsyncForeignUse, AsyncLease, AsyncUse
    from vram_arbiter.clients.sync import Client, ForeignUse, Lease, Use
    from vram_arbiter.schemas.errors import (
        ArbiterUnreachable,
        BadRequest,
        BadState,
        ConfigError,
        HostRamInsufficient,
        JournalUnavailable,
        LeaseExpired,
        LeaseLost,
        LeaseRevoking,
        LimitExceeded,
        LoadFailing,
        NotPermitted,
        StaleToken,
        UnknownGpu,
        UnknownLease,
        UntrustedServer,
        VersionMismatch,
        VramError,
        VramInsufficient,
        WaitTimeout,
        WouldDeadlock,
    )
    from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

__all__ = [
    "ArbiterUnreachable",
    "AsyncClient",
    "AsyncForeignUse",
    "AsyncLease",
    "AsyncUse",
    "BadRequest",
    "BadState",
    "Client",
    "ConfigError",
    "Eviction",
    "Footprint",
    "ForeignUse",
    "Handlers",
    "HostRamInsufficient",
    "JournalUnavailable",
    "Lease",
    "LeaseExpired",
    "LeaseLost",
    "LeaseRevoking",
    "LeaseSpec",
    "LimitExceeded",
    "LoadFailing",
    "NotPermitted",
    "StaleToken",
    "UnknownGpu",
    "UnknownLease",
    "UntrustedServer",
    "Use",
    "VersionMismatch",
    "VramError",
    "VramInsufficient",
    "WaitTimeout",
    "WouldDeadlock",
]

_HOME = {
    "AsyncClient": "clients.client",
    "AsyncForeignUse": "clients.lease",
    "AsyncLease": "clients.lease",
    "AsyncUse": "clients.lease",
    "Client": "clients.sync",
    "Eviction": "clients._protocol.records",
    "Footprint": "schemas.wire.spec",
    "ForeignUse": "clients.sync",
    "Handlers": "clients.handlers",
    "Lease": "clients.sync",
    "LeaseSpec": "schemas.wire.spec",
    "Use": "clients.sync",
}
"""Where a name is defined; the others are errors."""


def __getattr__(name: str) -> object:
    if name not in __all__:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = import_module(f"{__name__}.{_HOME.get(name, 'schemas.errors')}")
    value: object = getattr(module, name)
    globals()[name] = value
    return value


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
