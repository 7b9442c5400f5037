"""How a request waits, for reports: alone in its queues, or as its feature tells."""

from dataclasses import dataclass

from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.model.state import Core, Gpu


@dataclass(frozen=True, slots=True)
class Standing:
    """A request's GPU, company and prospects."""

    gpu: Gpu  # where it is, where room is made for it, or where it may be placed
    request: Lease  # as it is admitted there: the requests of a group count as one
    fellows: tuple[Lease, ...]  # requests that have one place in the queues together
    loads: tuple[Lease, ...] | None  # to be loaded there, up to this one; None: not known yet
    group: str = ""  # name of the group that it is granted with
    reserved_bytes: int = 0  # charged already, for its turn to load
    condition: str = ""
    outlook: str = ""
    gives_up: tuple[float, str] | None = None  # when its group is broken, and on which condition


def standing_of(core: Core, lease: Lease) -> Standing:
    """Return the standing of a request, or of a granted lease whose group is not complete."""
    for feature in lease.features:
        told = feature.standing(core, lease)
        if told is not None:
            return told
    gpu = core.gpus[lease.gpu or lease.request.planned_gpu or lease.request.gpus[0]]
    return Standing(gpu, lease, (lease,), (lease,))
