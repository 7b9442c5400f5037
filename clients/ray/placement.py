"""Order of the boxes for one model: pure, of the views that they gave. It imports no Ray.

An order is advice. It may be seconds old when it is followed, and the box's arbiter decides.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from functools import partial
from random import Random
from typing import Final, NoReturn

from vram_arbiter.schemas.errors import VramInsufficient
from vram_arbiter.schemas.sizes import format_bytes
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import GpuView

STALE_S: Final = 3.0
"""Age after which a view says nothing about its box."""


class Reason(StrEnum):
    """Why a box has its place in the order; best first."""

    RESIDENT = "resident"  # the model is held or loading there, and another copy fits beside it
    PARKED = "parked"  # parked or in standby there, and a copy fits
    FREE = "free"  # a copy fits
    EVICTABLE = "evictable"  # a copy fits once idle leases are evicted
    BUSY = "busy"  # a copy fits once others have ended their uses
    UNKNOWN = "unknown"  # no view, an old one, or no reading of its GPU
    TOO_SMALL = "too_small"  # no GPU there has the budget


UNUSABLE: Final = frozenset({Reason.UNKNOWN, Reason.TOO_SMALL})
_WARM: Final = {
    **dict.fromkeys(("held", "loading"), Reason.RESIDENT),
    **dict.fromkeys(("parked", "standby"), Reason.PARKED),
}
"""By the state of a lease."""


@dataclass(frozen=True, slots=True)
class Room:
    """A GPU. `free_bytes` is None where the arbiter has no reading or grants nothing."""

    free_bytes: int | None
    budget_bytes: int
    evictable_bytes: int = 0
    """Of idle leases that may be evicted."""


@dataclass(frozen=True, slots=True)
class View:
    """What the arbiter of a box says. `at`: monotonic seconds of the reader, when it was asked."""

    box: str
    gpus: tuple[Room, ...]
    resident: Mapping[str, str]
    """State by model, the most useful one where several leases have it."""
    waiting: int
    at: float = 0.0


@dataclass(frozen=True, slots=True)
class Ranked:
    """A box in the order. Bytes are those of the GPU that would be chosen; None: unknown."""

    node: str
    box: str
    reason: Reason
    waiting: int = 0
    free_bytes: int | None = None
    evictable_bytes: int | None = None
    budget_bytes: int | None = None

    @property
    def usable(self) -> bool:
        """Whether an actor may be placed there."""
        return self.reason not in UNUSABLE


def view_of(status: StatusReply, box: str) -> View:
    """Return what a placement needs of an arbiter's status."""
    resident: dict[str, str] = {}
    idle: dict[str | None, int] = {}
    for lease in status.leases:
        reason = _WARM.get(lease.state)
        if reason is Reason.RESIDENT or (reason and lease.model not in resident):
            resident[lease.model] = lease.state
        if lease.state == "held" and lease.evictable and not lease.uses and not lease.pinned:
            idle[lease.gpu] = idle.get(lease.gpu, 0) + lease.charge_bytes
    gpus = tuple(_room(gpu, idle.get(gpu.gpu, 0)) for gpu in status.gpus)
    return View(box, gpus, resident, status.totals.waiting)


def _room(gpu: GpuView, idle_bytes: int) -> Room:
    """Free is what both the ledger and the reading leave; a load in progress ends by itself."""
    budget = gpu.capacity_bytes - gpu.reserve_bytes
    blocked = gpu.blocked is not None and gpu.blocked.code is not Block.LOADING
    if gpu.measured_used_bytes is None or blocked:
        return Room(None, budget, idle_bytes)
    taken = max(gpu.charged_bytes + gpu.stowaway_bytes, gpu.measured_used_bytes)
    return Room(max(0, budget - taken), budget, idle_bytes)


def rank(
    views: Mapping[str, View | None], need_bytes: int, model: str, now: float, rng: Random
) -> list[Ranked]:
    """Return all nodes, best first; those that are not `usable` come last.

    Equals, boxes of one reason, are ordered by two random choices, the better of which comes first:
    callers that follow one old view do not all meet on one box (Mitzenmacher, "The power of two
    choices in randomized load balancing", 2001).

    Raises: VramInsufficient if every box is known, and `need_bytes` exceeds each GPU's budget.
    """
    places: dict[Reason, list[Ranked]] = {reason: [] for reason in Reason}
    for node, view in views.items():
        one = _placed(node, view, need_bytes, model, now)
        places[one.reason].append(one)
    if views and len(places[Reason.TOO_SMALL]) == len(views):
        _refuse(places[Reason.TOO_SMALL], need_bytes, model)
    return [one for equals in places.values() for one in _two_choices(equals, rng)]


def _placed(node: str, view: View | None, need_bytes: int, model: str, now: float) -> Ranked:
    """Judge one node by the GPU that suits best."""
    if view is None or now - view.at > STALE_S:
        return Ranked(node, view.box if view else "", Reason.UNKNOWN)
    told = partial(Ranked, node, view.box)
    budget = max((room.budget_bytes for room in view.gpus), default=0)
    if need_bytes > budget:
        return told(Reason.TOO_SMALL, budget_bytes=budget)
    known = [
        (room.free_bytes, room.evictable_bytes, room.budget_bytes)
        for room in view.gpus
        if room.free_bytes is not None and room.budget_bytes >= need_bytes
    ]
    if not known:
        return told(Reason.UNKNOWN, budget_bytes=budget)
    free, evictable, budget = max(known, key=lambda gpu: (gpu[0] >= need_bytes, gpu[0] + gpu[1]))
    if free >= need_bytes:
        reason = _WARM.get(view.resident.get(model, ""), Reason.FREE)
    else:
        reason = Reason.EVICTABLE if free + evictable >= need_bytes else Reason.BUSY
    return told(reason, view.waiting, free, evictable, budget)


def _two_choices(equals: Iterable[Ranked], rng: Random) -> Iterator[Ranked]:
    left = list(equals)
    while left:
        two = rng.sample(range(len(left)), min(2, len(left)))
        best = min(two, key=lambda at: (left[at].waiting, -(left[at].free_bytes or 0)))
        left[best], left[-1] = left[-1], left[best]
        yield left.pop()


def _refuse(boxes: Iterable[Ranked], need_bytes: int, model: str) -> NoReturn:
    greatest = max(boxes, key=lambda one: one.budget_bytes or 0)
    budget = greatest.budget_bytes or 0
    raise VramInsufficient(
        f"{model} needs {format_bytes(need_bytes)}, and the greatest budget is "
        f"{format_bytes(budget)}, on {greatest.box}",
        hint="use a smaller or quantized model, or add a box with a larger GPU",
        details={"need_bytes": need_bytes, "budget_bytes": budget, "box": greatest.box},
    )
