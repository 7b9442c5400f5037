"""Admission: whether there is a place for one more request, on which GPUs it may ever be granted,
and whether one can grant it now.

A grant passes two gates: the ledger (`fits`), and the newest reading (`measured_room_bytes`,
`measured_need_bytes`). Changes nothing.
"""

from collections.abc import Callable, Collection, Mapping, Set

from vram_arbiter.arbiter.core.ledger import NOTHING
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LEAVING, Lease
from vram_arbiter.arbiter.core.model.refusals import Limit, LimitReached, Refused, Share
from vram_arbiter.arbiter.core.model.state import Client, Waiting
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.spec import LeaseSpec


# -- places that processes and users share
def check_waiters(settings: Settings, waiting: Waiting, client: Client, priority: int) -> None:
    """Refuse one waiter too many of a client, of its user or of all.

    The last places are kept for requests above the default priority, of each user's share too.
    """
    places, taken = settings.waiters_max, waiting.of
    mine, users = taken.get(client.process, 0), taken.get(client.uid, 0)
    kept = 0.0 if priority > defaults.PRIORITY else settings.priority_reserve
    check_shares(
        "waiters_max",
        (Share.PROCESS, mine, places * settings.process_share),
        (Share.USER, users, places * (settings.user_share * (1 - kept))),
        (Share.ALL, len(waiting), places * (1 - kept)),
        uid=client.uid,
    )


def check_shares(
    limit: Limit, *shares: tuple[Share, int, float], lease_id: str = "", uid: int | None = None
) -> None:
    """Refuse one place more for the first share that is used up; each has one place at least.

    No process and no user can take so many places that others find none. Sessions, connections and
    rates are limited before a request becomes an event (`rpc`).

    Args:
        shares: Whose share, places taken, places allowed.
    """
    for share, count, most in shares:
        if count >= max(1, int(most)):
            user = uid if share is Share.USER else None
            raise Refused(LimitReached(limit, max(1, int(most)), share, count, lease_id, user))


# -- which GPUs
def selected(gpus: Mapping[GpuId, Gpu], spec: LeaseSpec) -> list[Gpu]:
    """Return the GPUs that a selector names: `any`, a UUID or an index."""
    return [gpu for gpu in gpus.values() if spec.gpu in ("any", gpu.info.id, str(gpu.info.index))]


def places(gpus: Mapping[GpuId, Gpu], spec: LeaseSpec, load_peak: int) -> tuple[GpuId, ...]:
    """Return the candidate GPUs of a request. Raises Refused if none could ever hold it.

    Pinned holders do not count: they end one day, and the request may wait as long as its timeout
    allows.
    """
    named = selected(gpus, spec)
    if not named:
        raise Refused(no.UnknownGpu(spec.gpu, tuple(gpus)))
    able = [gpu.info.id for gpu in named if load_peak <= gpu.ledger.budget_bytes]
    if able:
        return tuple(able)
    largest = max(named, key=lambda gpu: (gpu.ledger.budget_bytes, -gpu.info.index))
    info = largest.info
    sizes = (load_peak, spec.footprint.load_peak_bytes, info.capacity_bytes, info.reserve_bytes)
    raise Refused(no.TooLarge(spec.consumer, *sizes))


def front(gpus: Mapping[GpuId, Gpu], gpu: Gpu) -> Lease | None:
    """Return the request that a GPU serves: its head, or the first for which no other GPU is being
    emptied.

    A GPU is no longer emptied for a request once its last holder there is past the deadline, or has
    left and that was not enough.
    """
    head = gpu.queue.head
    if head is None or head.request.planned_gpu in (None, gpu.info.id) or fits(gpu, head):
        return head
    for lease in gpu.queue:
        there = lease.request.planned_gpu
        if there is None or there == gpu.info.id:
            return lease
        asked = [one for one in gpus[there].evictions if one.wanted_by == lease.id]
        if all(one.verdict or one.overdue for one in asked):
            return lease
    return None


# -- what a GPU can grant
def leaving(gpu: Gpu) -> dict[LeaseId, int]:
    """Return leases whose bytes are pending free, with what each retains; not the late ones."""
    going: dict[LeaseId, int] = {}
    by_state = gpu.residents.by_state
    for lease in [lease for state in LEAVING for lease in by_state[state].values()]:
        departure, verification = lease.departure, gpu.verifications.get(lease.id)
        if verification is not None:
            late = verification.overdue
        else:
            late = departure.hangs or bool(departure.eviction and departure.eviction.overdue)
        if not late:
            going[lease.id] = lease.residue_bytes
    for debt in gpu.verifications.values():
        if debt.lease is not None and debt.lease not in gpu.residents and not debt.overdue:
            going[debt.lease] = debt.retained_bytes
    return going


def residue_under_measurement(gpu: Gpu) -> bool:
    """Return whether a dead process's retained bytes are measured: nothing is revoked meanwhile."""
    return any(one.lease is None and not one.overdue for one in gpu.verifications.values())


# -- the ledger's gate
def joining(lease: Lease) -> Collection[tuple[ProcessKey, int]]:
    """Return what a grant charges, by process: the load peak."""
    return ((lease.process, lease.request.load_peak_bytes),)


def fits(gpu: Gpu, lease: Lease, going: Mapping[LeaseId, int] = NOTHING) -> bool:
    """Return whether the ledger holds a request at its load peak, once leases in `going` left.

    An exclusive request needs the GPU for itself. Any other waits for exclusive leases, also for
    one that is over and not measured gone yet.
    """
    if lease.spec.mode == "exclusive":
        apart: Set[LeaseId | None] = gpu.ledger.charges.keys()
    else:
        apart = {
            *gpu.residents.exclusive,
            *[one.lease for one in gpu.verifications.values() if one.exclusive],
        }
    if not apart <= going.keys():
        return False
    return gpu.ledger.total_if(going, joining(lease)) <= gpu.ledger.budget_bytes


def added_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return what a grant adds to the ledger: the load peak less the retained bytes it replaces."""
    return gpu.ledger.total_if(joining=joining(lease)) - gpu.ledger.total_bytes()


def excess_bytes_alone(gpu: Gpu, lease: Lease) -> int:
    """Return by how much a request exceeds the GPU once every other lease has left, beside what
    live processes retain and stowaways hold; negative: it fits."""
    others = {one.id: one.residue_bytes for one in gpu.residents.values() if one is not lease}
    return gpu.ledger.total_if(others, joining(lease)) - gpu.ledger.budget_bytes


def spare_unplanned_bytes(
    gpu: Gpu, head: Lease, going: Mapping[LeaseId, int], stays: Callable[[Lease], bool]
) -> tuple[int, bool]:
    """Return what a later request may take without delaying a head without a plan, and whether the
    head waits for bytes of no holder.

    Every lease may leave some day, except those that took their room while the head waited before
    them (`stays`). If the head would not fit even then, it is served when stowaways leave, and else
    when processes with retained bytes end. Only what remains beside it on that day may be taken
    now.
    """
    ledger, joins, residents = gpu.ledger, joining(head), gpu.residents.values()
    everything = {**{one.id: one.residue_bytes for one in residents}, **going}
    movable = {**{one.id: one.residue_bytes for one in residents if not stays(one)}, **going}
    day = ledger.total_if(everything, joins)
    stay_bytes = ledger.total_if(movable, joins) - day
    stuck = day > ledger.budget_bytes
    if stuck:
        day = ledger.total_if(everything, joins, stowaways=False)
    if day > ledger.budget_bytes:
        day = sum(count for _, count in joins)
    return ledger.budget_bytes - day - stay_bytes, stuck


# -- the reading's gate
def measured_room_bytes(gpu: Gpu, oldest: float) -> int | None:
    """Return free bytes by the newest reading, less the leases that it cannot have seen; None: no
    reading that began at `oldest` or later can tell.

    A lease that became ready since counts with its load peak: what it freed at the end of its load
    may not be back yet. A lease that was granted and lost since may still be there, with its load
    peak too.
    """
    sample = gpu.sample
    if sample is None or gpu.failed_at is not None or sample.taken_at < oldest:
        return None
    for debt in gpu.verifications.values():
        unseen = debt.lease not in gpu.residents and debt.confirmed_at > sample.taken_at
        if unseen and not debt.baseline_comparable:
            return None
    room = min(gpu.info.capacity_bytes, sample.total_bytes) - sample.used_bytes
    for lease in gpu.residents.unseen(sample.taken_at):
        room -= max(gpu.ledger.charge_bytes(lease.id), lease.request.load_peak_bytes)
    return room


def measured_need_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return what the reading must show as free: what a grant charges, less what a process without
    other leases holds already (its context)."""
    needed, account = lease.request.load_peak_bytes, gpu.ledger.accounts.get(lease.process)
    if account is not None and account.charges:
        return needed
    own = gpu.shown_bytes(lease.process)
    if own is None:
        own = 0 if account is None else account.retained_bytes
    return max(0, needed - own)
