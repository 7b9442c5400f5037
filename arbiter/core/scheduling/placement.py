"""Placement: on which GPUs a request may ever be granted, and which of several is emptied for it.

Public: `selected`, `places`, `front`, `placed_elsewhere`, `is_best_place`. A pinned holder ends one
day: a request that only it keeps out waits, as long as its own timeout allows.
"""

from collections.abc import Sequence

from vram_arbiter.arbiter.core.events import LeaseSpec
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.scheduling.admission import blocked, fits, leaving
from vram_arbiter.arbiter.core.scheduling.victims import choose_victims, cost_of
from vram_arbiter.schemas.ids import GpuId


def selected(core: Core, spec: LeaseSpec) -> list[Gpu]:
    """Return the GPUs that a selector names: `any`, a UUID or an index."""
    return [
        gpu for gpu in core.gpus.values() if spec.gpu in ("any", gpu.info.id, str(gpu.info.index))
    ]


def places(core: Core, spec: LeaseSpec, load_peak: int) -> tuple[GpuId, ...]:
    """Return the candidate GPUs of a request. Raises Refused if none could ever hold it."""
    gpus = selected(core, spec)
    if not gpus:
        raise Refused(no.UnknownGpu(spec.gpu, tuple(gpu.info.id for gpu in core.gpus.values())))
    able = tuple(gpu.info.id for gpu in gpus if load_peak <= gpu.ledger.budget_bytes)
    if able:
        return able
    largest = max(gpus, key=lambda gpu: (gpu.ledger.budget_bytes, -gpu.info.index))
    info = largest.info
    sizes = (load_peak, spec.load_peak_bytes, info.capacity_bytes, info.reserve_bytes)
    raise Refused(no.TooLarge(spec.consumer, *sizes))


# -- which of several GPUs ---------------------------------------------------------------
def placed_elsewhere(core: Core, gpu: Gpu, lease: Lease) -> bool:
    """Return whether another GPU is being emptied for this request; here it then waits for nothing.

    No longer once a holder there is past its deadline, or left and that was not enough.
    """
    there = lease.request.planned_gpu
    if there is None or there == gpu.info.id:
        return False
    return any(
        e.wanted_by == lease.id and not e.verdict and not e.overdue
        for e in core.gpus[there].evictions
    )


def front(core: Core, gpu: Gpu) -> Lease | None:
    """Return the request to serve: the head, or the first for which no other GPU is emptied."""
    head = gpu.queue.head()
    if head is None or not placed_elsewhere(core, gpu, head) or fits(gpu, head):
        return head
    return next((lease for lease in gpu.queue if not placed_elsewhere(core, gpu, lease)), None)


def is_best_place(core: Core, gpu: Gpu, waiter: Lease, plan: Sequence[Lease]) -> bool:
    """Return whether emptying this GPU is the cheapest of its candidates. Wakes a better one."""
    best, best_cost = gpu, cost_of(plan, gpu.info.index)
    for gpu_id in waiter.request.gpus:
        other = core.gpus[gpu_id]
        if other is gpu or other.queue.head() is not waiter:
            continue
        going = leaving(other)
        if (patience_ends_at := _load_ends_by(core, other)) > core.now and fits(
            other, waiter, going
        ):
            core.timers.set(("plan", gpu.info.id), patience_ends_at)
            return False  # it is the next there, once the load has ended
        if blocked(core, other):
            continue
        if fits(other, waiter, going):
            return False  # room comes there anyway
        rival = choose_victims(core, other, waiter, going)
        if rival is not None and cost_of(rival, other.info.index) < best_cost:
            best, best_cost = other, cost_of(rival, other.info.index)
    if best is gpu:
        return True
    core.wake(best)
    return False


def _load_ends_by(core: Core, gpu: Gpu) -> float:
    """Return until when a load here is awaited rather than emptying another GPU; 0: it is not."""
    loading = gpu.in_state(LeaseState.LOADING)
    if (
        not loading
        or gpu.failed_at is not None
        or gpu.sample is None
        or gpu.keeper is not None
        or gpu.pressed
    ):
        return 0.0
    return loading[0].granted_at + core.settings.revoke_deadline_s
