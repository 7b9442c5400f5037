"""What leaving and coming back costs, learnt: seconds to reload, how likely that is to be wanted,
and which consumers keep switching.

Only ever orders victims that are otherwise alike, and stretches a residency within a cap: nothing
learnt can make a wait endless.
"""

from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.model.state import Core, Reuse

REUSE_WITHIN_S = 60.0
"""A consumer that is wanted again this soon after it left should rather have stayed."""


def left(core: Core, consumer: str) -> None:
    """Its bytes are measured gone."""
    core.seen_leaving(consumer)


def wanted(core: Core, consumer: str) -> None:
    """It asks for a card: soon after it left, or not."""
    seen = core.reuse.get(consumer)
    if seen is not None and seen.left_at is not None:
        seen.soon.append(core.now - seen.left_at <= REUSE_WITHIN_S)
        seen.left_at = None


def reload_s(core: Core, lease: Lease) -> float:
    """Seconds of loading that its leaving is expected to cost, to a tenth. Never seen: nothing."""
    load = core.learnt_s(lease.spec.consumer, "load_s") or 0.0
    chance = core.reuse.get(lease.spec.consumer, Reuse()).chance()
    return round(load * chance, 1)


def can_park(core: Core, lease: Lease) -> bool:
    """Would its weights find room in host RAM?"""
    return any(feature.can_park(lease) for feature in lease.features)


# -- thrash
def switched(core: Core, gone: str, came: str) -> None:
    """One consumer made room for another. Pairs that have not switched for a while are
    forgotten."""
    window_s = core.settings.thrash_window_s
    for pair in [pair for pair, at in core.switches.items() if at <= core.now - window_s]:
        del core.switches[pair]
    core.switches[gone, came] = core.now


def hold_s(core: Core, holder: Lease, waiter: Lease) -> float:
    """How long a holder may stay against this waiter because the two keep throwing each other out:
    one switch's learnt cost, capped.

    Nothing against a waiter of higher priority, nor once a pair has not switched both ways within
    the window.
    """
    a, b = holder.spec.consumer, waiter.spec.consumer
    if waiter.spec.priority > holder.spec.priority or not (
        _lately(core, a, b) and _lately(core, b, a)
    ):
        return 0.0
    phases = ((a, "unload_s"), (a, "verify_s"), (b, "load_s"))
    cost = sum(core.learnt_s(consumer, phase) or 0.0 for consumer, phase in phases)
    return min(cost, core.settings.thrash_hold_max_s)


def _lately(core: Core, gone: str, came: str) -> bool:
    at = core.switches.get((gone, came))
    return at is not None and at > core.now - core.settings.thrash_window_s
