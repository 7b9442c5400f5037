"""How a request waits, for reports: alone in its queues, or as its feature tells."""

from dataclasses import dataclass

from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.wire.explained import Because, Return
from vram_arbiter.schemas.wire.views import GangView


@dataclass(frozen=True, slots=True)
class Standing:
    """A request's GPU, company and prospects."""

    gpu: Gpu  # where it is, where room is made for it, or where it may be placed
    request: Lease  # as it is admitted there: the requests of a group count as one
    fellows: tuple[Lease, ...]  # requests that have one place in the queues together
    loads: tuple[Lease, ...] | None  # to be loaded there, up to this one; None: not known yet
    gang: GangView | None = None  # that it is granted with
    lacks: tuple[Lease, ...] = ()  # other members of it that are not held
    back: Return | None = None  # what it waits for where it is away
    ahead: str = ""  # consumer before it then
    due_s: float | None = None
    reserved_bytes: int = 0  # charged already, for its turn to load
    gives_up: tuple[float, Because] | None = None  # when its gang is broken, and why


def standing_of(core: Core, lease: Lease) -> Standing:
    """Return the standing of a request, or of a granted lease whose group is not complete."""
    for feature in lease.features:
        told = feature.standing(core, lease)
        if told is not None:
            return told
    gpu = core.gpus[lease.gpu or lease.request.planned_gpu or lease.request.gpus[0]]
    return Standing(gpu, lease, (lease,), (lease,))
