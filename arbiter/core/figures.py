"""The present in numbers, for telemetry: who waits, and what every card holds. Reads only, no words; O(residents and processes)."""

from typing import Any

from arbiter.core.state import Core, Gpu
from schemas.ids import ProcessKey

RESIDUES = "(residues)"
"""Stands for bytes that no resident lease has: residues of living processes, debts of leases that are over, what a gang keeps free."""
STOWAWAYS = "(stowaways)"
"""Stands for processes without a lease."""


def figures(core: Core) -> dict[str, Any]:
    """`{"waiters", "gpus": [{"gpu", "capacity_bytes", "charged": {consumer: bytes}, "measured": {consumer: bytes} or None}]}`.

    `measured` is None while the card is unknown; its key "" is the whole card. A process with leases of several consumers counts once,
    under their names joined by "+": nobody can tell its bytes apart.
    """
    return {"waiters": len(core.waiting), "gpus": [_card(gpu) for gpu in core.gpus.values()]}


def _card(gpu: Gpu) -> dict[str, Any]:
    charged: dict[str, int] = {}
    consumers: dict[ProcessKey, set[str]] = {}
    for lease in gpu.residents.values():
        name = lease.spec.consumer
        charged[name] = charged.get(name, 0) + gpu.ledger.charge_bytes(lease.id)
        consumers.setdefault(lease.process, set()).add(name)
    if rest := gpu.ledger.booked_bytes() - sum(charged.values()):
        charged[RESIDUES] = rest
    return {
        "gpu": gpu.info.id,
        "capacity_bytes": gpu.info.capacity_bytes,
        "charged": charged,
        "measured": _measured(gpu, consumers),
    }


def _measured(gpu: Gpu, consumers: dict[ProcessKey, set[str]]) -> dict[str, int] | None:
    sample = gpu.sample
    if sample is None or gpu.failed_at is not None:
        return None
    measured = {"": sample.used_bytes}
    for use in sample.processes or ():
        if use.used_bytes is None:
            continue  # the driver lists it and does not say
        if use.process in consumers:
            name = "+".join(sorted(consumers[use.process]))
        else:
            name = RESIDUES if use.process in gpu.ledger.accounts else STOWAWAYS
        measured[name] = measured.get(name, 0) + use.used_bytes
    return measured
