"""The present in numbers, for telemetry: waiters, and what every GPU holds. Reads only, no
words; O(residents and processes)."""

from typing import Any

from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import ProcessKey

RESIDUES = "(residues)"
"""Stands for bytes that no resident lease has: residues of living processes, debts of leases that
are over, what a gang keeps free."""
STOWAWAYS = "(stowaways)"
"""Stands for processes without a lease."""
UNATTRIBUTED = "(unattributed)"
"""Stands for bytes of a reading that no listed process explains."""


def figures(core: Core) -> dict[str, Any]:
    """Return `{"waiters", "drained", "gpus": [{"gpu", "capacity_bytes", "pressure_bytes",
    "used_bytes", "read_at", "charged", "measured"}]}`.

    `charged` and `measured` are bytes by consumer. `measured` and `used_bytes` are None while the
    GPU is unknown; the bytes of `measured` add up to `used_bytes`, or to more where the driver's
    list and its total disagree. A process with leases of several consumers counts once, under their
    names joined by "+": its bytes cannot be told apart. `read_at`: monotonic seconds of the newest
    successful reading, None before the first.
    """
    return {
        "waiters": len(core.waiting),
        "drained": core.drain is not None,
        "gpus": [_card(gpu) for gpu in core.gpus.values()],
    }


def _card(gpu: Gpu) -> dict[str, Any]:
    charged: dict[str, int] = {}
    consumers: dict[ProcessKey, set[str]] = {}
    for lease in gpu.residents.values():
        name = lease.spec.consumer
        charged[name] = charged.get(name, 0) + gpu.ledger.charge_bytes(lease.id)
        consumers.setdefault(lease.process, set()).add(name)
    if rest := gpu.ledger.booked_bytes() - sum(charged.values()):
        charged[RESIDUES] = rest
    measured = _measured(gpu, consumers)
    return {
        "gpu": gpu.info.id,
        "capacity_bytes": gpu.info.capacity_bytes,
        "pressure_bytes": gpu.ledger.pressure_bytes(),
        "used_bytes": gpu.sample.used_bytes
        if measured is not None and gpu.sample is not None
        else None,
        "read_at": None if gpu.sample is None else gpu.sample.taken_at,
        "charged": charged,
        "measured": measured,
    }


def _measured(gpu: Gpu, consumers: dict[ProcessKey, set[str]]) -> dict[str, int] | None:
    sample = gpu.sample
    if sample is None or gpu.failed_at is not None:
        return None
    measured: dict[str, int] = {}
    for use in sample.processes or ():
        if use.used_bytes is None:
            continue  # the driver lists it and does not say
        if use.process in consumers:
            name = "+".join(sorted(consumers[use.process]))
        else:
            name = RESIDUES if use.process in gpu.ledger.accounts else STOWAWAYS
        measured[name] = measured.get(name, 0) + use.used_bytes
    if (rest := sample.used_bytes - sum(measured.values())) > 0:
        measured[UNATTRIBUTED] = rest
    return measured
