"""Gangs: several leases that are granted together or not at all, over one card or several, of one process or many.

A gang *gathers* until all its members have asked, *waits* as one with the place of its lowest priority aged from its first member, and
*loads* once there is room for all: every member's steady bytes are charged at that moment, and on each card the largest headroom that one
of them needs on top while it loads. Members load one after the other per card, and nobody else is granted there meanwhile. When all
are held the gang is complete, and its members are leases like any other. A member that fails before breaks it: who waits is denied,
who holds keeps what it has.
"""

from collections.abc import Callable, Iterable
from dataclasses import replace

from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.model.lease import EXPIRING, Gang, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu, Refused
from vram_arbiter.arbiter.core.scheduling import policy
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey

SEARCH_MAX = 4096
"""Placements that are looked at; a gang that could be placed in more ways is placed as far as this goes."""

type _Placement = dict[GpuId, list[Lease]]


# -- gathering ---------------------------------------------------------------------------------------------------------
def check(core: Core, name: str, size: int) -> None:
    """May one more member join? Raises Refused."""
    gang = core.gangs.get(name)
    if gang is None:
        return
    if gang.size != size:
        raise Refused(
            "bad_request",
            f"gang {name} has {gang.size} members, not {size}",
            "agree on one size",
            size=gang.size,
        )
    if len(gang.members) >= gang.size:
        raise Refused(
            "bad_request",
            f"all {size} members of gang {name} have come",
            "use an id of its own for each gang",
        )


def join(core: Core, lease: Lease, name: str, size: int) -> None:
    """A member asks. It stands in no queue before all have come."""
    gang = _gang(core, name, size)
    lease.gang = gang
    gang.members.append(lease)
    core.hold_back(lease)
    if len(gang.members) == gang.size:
        _complete(core, gang)


def left_out(core: Core, name: str, why: str) -> None:
    """A member was refused: its gang can never be complete."""
    gang = core.gangs.get(name)
    if gang is not None and gang.phase == "gathering":
        _break(core, gang, why)


def restore(core: Core, lease: Lease, name: str, size: int) -> None:
    """A member that was granted before the restart. The others ask again, by their nonces; they are waited for as holders are."""
    gang = _gang(core, name, size)
    lease.gang = gang
    gang.members.append(lease)
    core.timers.set(("gang", name), core.now + defaults.LEASE_TTL_S + core.settings.fence_grace_s)


def on_due(core: Core, name: str) -> None:
    gang = core.gangs.get(name)
    if gang is not None and gang.phase == "gathering":
        _break(core, gang, "not all of it came back after the restart")


def _gang(core: Core, name: str, size: int) -> Gang:
    core.unsettled.add(name)
    return core.gangs.setdefault(name, Gang(name, size, core.now, unsettled=core.unsettled))


def _complete(core: Core, gang: Gang) -> None:
    """All have come. What can never fit is said at once, to all; else they stand in the queues as one."""
    waiting = gang.waiting()
    if not _place(core, waiting, lambda gpu, some: _ever(core, gpu, some)):
        needed = sum(_needs(waiting).values())
        budgets = {gpu.info.id: gpu.ledger.budget_bytes for gpu in core.gpus.values()}
        _break(
            core,
            gang,
            f"its {len(waiting)} members need {needed} bytes together, more than the cards can ever hold",
            code="vram_insufficient",
            needed_bytes=needed,
            budget_bytes=budgets,
        )
        return
    gang.phase = "waiting"
    ageing_s = core.settings.ageing_s_per_point if core.settings.scheduling.by_priority else 0.0
    for lease in waiting:
        lease.rank = gang.first_at - gang.priority * ageing_s
        for gpu_id in lease.gpus:
            core.gpus[gpu_id].queue.add(lease)
            core.wake(core.gpus[gpu_id])


# -- waiting -----------------------------------------------------------------------------------------------------------
def serve(core: Core, gpu: Gpu, gang: Gang) -> None:
    """A member is the head of this card: grant all if all fit, else ask whom it takes, if that lets all of them in."""
    waiting = gang.waiting()
    fitting = _place(
        core, waiting, lambda card, some: _is_next(core, card, gang) and _fits(card, gang, some)
    )
    if fitting:
        measured = [
            _measured(core, card, gang, some) for card, some in _cards(core, fitting)
        ]  # each asks for its reading
        if all(measured):
            _admit(core, gang, fitting)
        return
    planned = {card: [one for one in some if one in waiting] for card, some in gang.planned.items()}
    placement: _Placement | None = planned
    if not planned or not all(
        _can_be_made(core, card, gang, some) for card, some in _cards(core, planned)
    ):
        placement = _place(core, waiting, lambda card, some: _can_be_made(core, card, gang, some))
    gang.planned = placement or {}
    if not placement:
        _say(waiting, "nobody who could make room for the whole gang may be asked now")
        policy.wake_when_evictable(core, gpu, _bundle(gang, waiting))
        return
    _say(waiting, "room is being made for the whole gang")
    for card, some in _cards(core, placement):
        bundle, going = _bundle(gang, some), policy.leaving(card)
        if policy.fits(card, bundle, going):
            continue
        for victim in policy.choose_victims(core, card, bundle, going) or ():
            eviction.ask(core, card, victim, some[0], f"gang {gang.name} needs the room")


def _is_next(core: Core, gpu: Gpu, gang: Gang) -> bool:
    front = policy.front(core, gpu)
    return front is not None and front.gang is gang and not policy.blocked(core, gpu)


def _fits(gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
    return not _clash(some) and policy.fits(gpu, _bundle(gang, some))


def _can_be_made(core: Core, gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
    if not _is_next(core, gpu, gang) or _clash(some) or policy.residue_under_measurement(gpu):
        return False
    going = policy.leaving(gpu)
    bundle = _bundle(gang, some)
    return (
        policy.fits(gpu, bundle, going)
        or policy.choose_victims(core, gpu, bundle, going) is not None
    )


def _measured(core: Core, gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
    """The card's own word, once for all that is loaded on it from here on."""
    room = policy.measured_room_bytes(core, gpu)
    need = policy.measured_need_bytes(gpu, _bundle(gang, some))
    if room is None or (room < need and policy.sample_is_behind(gpu)):
        _say(some, "waits for a fresh reading of the card")
        core.want_sample(gpu, max(gpu.changed_at, core.now - core.settings.sample_max_age_s))
        return False
    if room < need:
        gpu.blocked = "the ledger has room, the card does not: measured memory is not free yet"
        _say(some, gpu.blocked)
    return room >= need


# -- loading -----------------------------------------------------------------------------------------------------------
def _admit(core: Core, gang: Gang, placement: _Placement) -> None:
    """Charge everybody in one breath. From here on all of them have their bytes, whoever loads first."""
    gang.phase, gang.planned = "loading", {}
    for gpu, some in _cards(core, placement):
        gang.cards.append(gpu.info.id)
        gpu.gang = gang
        for lease in some:
            for gpu_id in lease.gpus:
                core.gpus[gpu_id].queue.discard(lease)
                core.wake(core.gpus[gpu_id])
            lease.gpus, lease.gpu, lease.reason = (gpu.info.id,), gpu.info.id, ""
            gpu.ledger.reserve(lease.id, lease.process, lease.steady_bytes, core.now)
        _set_headroom(core, gpu, gang, _headroom_bytes(some))
        here = [one.id for one in gang.members if one.gpu == gpu.info.id]
        gang.reserved_bytes[gpu.info.id] = sum(
            _approved(gpu, one) for one in [*here, gang.headroom_id]
        )
        core.wake(gpu)
    core.note(
        "gang",
        gang=gang.name,
        phase="loading",
        members=[lease.id for lease in gang.members],
        reason="all fit",
    )


def next_load(core: Core, gpu: Gpu, gang: Gang) -> Lease | None:
    """The card is a loading gang's: who of it is to be granted now, if the one before is ready."""
    lease = next((one for one in gang.waiting() if one.gpu == gpu.info.id), None)
    if (
        lease is None
        or gpu.failed_at is not None
        or gpu.sample is None
        or gpu.in_state(LeaseState.LOADING)
    ):
        return None
    more = lease.load_peak_bytes - lease.steady_bytes
    headroom = _approved(gpu, gang.headroom_id)
    extra = max(0, more - headroom)
    if gpu.ledger.approved_bytes() + extra > gpu.ledger.budget_bytes:
        _break(core, gang, "a member holds more than it declared, the rest no longer fits")
        return None
    over = gpu.ledger.total_bytes() + extra - gpu.ledger.budget_bytes
    if over > 0:  # somebody else has grown since it was admitted
        going = policy.leaving(gpu)
        victims = [] if going else policy.choose_relief(core, gpu, going, over)
        for victim in victims:
            eviction.ask(core, gpu, victim, lease, f"gang {gang.name} needs the room")
        if not going and not victims:
            _break(core, gang, "others hold more than they were granted, the rest no longer fits")
        return None
    moved = min(
        headroom, more
    )  # it is booked on one of them, and may cover what he still shows of his peak
    total = gpu.ledger.total_if_moved(gang.headroom_id, moved, lease.process) if moved else 0
    if not _is_free(core, gpu, gang, lease, crowded=total + extra > gpu.ledger.budget_bytes):
        return None
    _set_headroom(core, gpu, gang, max(0, headroom - more))
    return lease


def _is_free(core: Core, gpu: Gpu, gang: Gang, lease: Lease, *, crowded: bool) -> bool:
    """What the member before needed on top of its steady bytes is not free before it is measured, as any bytes.

    Memory that does not come back in time breaks the gang: its other members must not hold a card for ever that nobody else may use.
    """
    room = policy.measured_room_bytes(core, gpu)
    if not crowded and room is not None and room >= policy.measured_need_bytes(gpu, lease):
        gang.short_since.pop(gpu.info.id, None)
        return True
    if room is None or policy.sample_is_behind(gpu):
        lease.reason = "waits for a fresh reading of the card"
        core.want_sample(gpu, max(gpu.changed_at, core.now - core.settings.sample_max_age_s))
        return False
    lease.reason = "its bytes are kept for it, but measured memory is not free yet"
    if (
        core.now - gang.short_since.setdefault(gpu.info.id, core.now)
        > core.settings.verify_timeout_s
    ):
        _break(core, gang, "measured memory did not come back, the rest no longer fits")
    else:
        core.read_again(gpu, core.settings.load_probe_s)
    return False


def settle(core: Core) -> None:
    """After an event: gangs of which a member is over are broken, those of which all are held are complete."""
    core.settled = set(core.unsettled)
    core.unsettled.clear()
    for gang in _concerned(core):
        fallen = next((one for one in gang.members if one.state not in _STANDING), None)
        if fallen is not None:
            ended = core.ended.get(fallen.id)
            why = "" if ended is None or ended.error is None else f": {ended.error['message']}"
            _break(core, gang, f"{fallen.spec.consumer} ({fallen.id}) is {fallen.state}{why}")
        elif len(gang.members) == gang.size and all(
            one.state is LeaseState.HELD for one in gang.members
        ):
            _finish(core, gang)
        elif gang.phase == "loading":
            for gpu_id in gang.cards:
                _trim(core, core.gpus[gpu_id], gang)


def _concerned(core: Core) -> list[Gang]:
    """Gangs of which a member has moved since the last event, and those that load: thousands may gather that nothing happens to."""
    names = {
        *core.settled,
        *core.unsettled,
        *(gpu.gang.name for gpu in core.gpus.values() if gpu.gang),
    }
    found = [core.gangs[name] for name in names if name in core.gangs]
    return sorted(found, key=lambda gang: (gang.first_at, gang.name))


_STANDING = frozenset({LeaseState.QUEUED, LeaseState.LOADING, LeaseState.HELD})


def _trim(core: Core, gpu: Gpu, gang: Gang) -> None:
    """While nobody loads here, keep what the next one needs on top, out of what was admitted and is not held."""
    if gpu.in_state(LeaseState.LOADING):
        return
    here = [one for one in gang.members if one.gpu == gpu.info.id]
    held = sum(_approved(gpu, one.id) for one in here)
    spare = gang.reserved_bytes[gpu.info.id] - held
    wanted = _headroom_bytes([one for one in here if one.state is LeaseState.QUEUED])
    if _approved(gpu, gang.headroom_id) != max(0, min(spare, wanted)):
        _set_headroom(core, gpu, gang, max(0, min(spare, wanted)))
        core.wake(gpu)


def _finish(core: Core, gang: Gang) -> None:
    _dissolve(core, gang)
    core.note(
        "gang",
        gang=gang.name,
        phase="complete",
        members=[one.id for one in gang.members],
        reason="all are held",
    )


def _break(core: Core, gang: Gang, why: str, code: str = "gang_broken", **details: object) -> None:
    waiting = [lease for lease in gang.waiting() if lease.id in core.waiting]
    _dissolve(core, gang)
    core.note(
        "gang", gang=gang.name, phase="broken", members=[one.id for one in gang.members], reason=why
    )
    error = {
        "code": code,
        "message": f"gang {gang.name}: {why}",
        "hint": "ask for all of it again",
        "details": {"gang": gang.name, "why": why, **details},
    }
    for lease in waiting:
        eviction.deny(core, lease, error)


def _dissolve(core: Core, gang: Gang) -> None:
    """Nobody is bound by it any more, and nothing is kept for it."""
    core.gangs.pop(gang.name, None)
    core.timers.clear(("gang", gang.name))
    for lease in gang.members:
        lease.gang = None
    for gpu_id in gang.cards:
        gpu = core.gpus[gpu_id]
        for lease in gang.members:
            if lease.id in gpu.ledger.reserved:
                gpu.ledger.withdraw(lease.id, core.now)
                lease.gpu = None
        _set_headroom(core, gpu, gang, 0)
        gpu.gang = None
        core.wake(gpu)
    for lease in gang.members:
        if lease.state in EXPIRING:
            core.record_lease(lease)  # a restart must not wait for the rest of it


# -- bytes -------------------------------------------------------------------------------------------------------------
def _needs(some: Iterable[Lease]) -> dict[ProcessKey, int]:
    """What an admission charges, by process: everybody's steady bytes and the largest headroom."""
    some = list(some)
    needs: dict[ProcessKey, int] = {}
    for lease in some:
        needs[lease.process] = needs.get(lease.process, 0) + lease.steady_bytes
    needs[some[0].process] += _headroom_bytes(some)
    return needs


def _headroom_bytes(some: Iterable[Lease]) -> int:
    return max((lease.load_peak_bytes - lease.steady_bytes for lease in some), default=0)


def _bundle(gang: Gang, some: list[Lease]) -> Lease:
    """Members on one card as a single waiter, as `policy` asks about."""
    first = some[0]
    spec = replace(
        first.spec, priority=gang.priority, exclusive=any(one.spec.exclusive for one in some)
    )
    return replace(first, spec=spec, arrived_at=gang.first_at, needs=_needs(some))


def _clash(some: list[Lease]) -> bool:
    return len(some) > 1 and any(one.spec.exclusive for one in some)


def _ever(core: Core, gpu: Gpu, some: list[Lease]) -> bool:
    """Would they fit if every lease ended but what their own unfinished gang holds already?"""
    mine = some[0].gang
    staying = [lease for lease in gpu.residents.values() if lease.gang is mine]
    fixed = sum(gpu.ledger.charge_bytes(lease.id) for lease in staying)
    alone = any(one.spec.exclusive for one in [*some, *staying])
    if alone and len(some) + len(staying) > 1:
        return False
    return fixed + sum(_needs(some).values()) <= gpu.ledger.budget_bytes


def _approved(gpu: Gpu, lease_id: LeaseId) -> int:
    return gpu.ledger.charge_of(lease_id).approved_bytes if gpu.ledger.charges(lease_id) else 0


def _set_headroom(core: Core, gpu: Gpu, gang: Gang, count: int) -> None:
    """Bytes that are kept for whoever of the gang loads next, in the account of one of its processes here."""
    if gpu.ledger.charges(gang.headroom_id):
        gpu.ledger.withdraw(gang.headroom_id, core.now)
    if count:
        owner = next(one for one in gang.members if one.gpu == gpu.info.id)
        gpu.ledger.reserve(gang.headroom_id, owner.process, count, core.now)


# -- placing -----------------------------------------------------------------------------------------------------------
def _place(
    core: Core, members: list[Lease], may: Callable[[Gpu, list[Lease]], bool]
) -> _Placement | None:
    """A card for everybody, or None. The largest choose first; cards in their order; what does not go together is not tried further."""
    order = sorted(
        members, key=lambda lease: (len(lease.gpus), -lease.load_peak_bytes, lease.arrival)
    )
    placement: _Placement = {}
    budget = SEARCH_MAX

    def extend(index: int) -> bool:
        nonlocal budget
        if index == len(order):
            return True
        lease = order[index]
        for gpu_id in lease.gpus:
            if budget <= 0:
                return False
            budget -= 1
            here = placement.setdefault(gpu_id, [])
            here.append(lease)
            if may(core.gpus[gpu_id], here) and extend(index + 1):
                return True
            here.pop()
            if not here:
                del placement[gpu_id]
        return False

    return placement if extend(0) else None


def _cards(core: Core, placement: _Placement) -> list[tuple[Gpu, list[Lease]]]:
    return [
        (gpu, placement[gpu.info.id]) for gpu in core.gpus.values() if placement.get(gpu.info.id)
    ]


def _say(some: Iterable[Lease], reason: str) -> None:
    for lease in some:
        lease.reason = reason


# -- telling -----------------------------------------------------------------------------------------------------------
def planned_on(lease: Lease) -> GpuId | None:
    """The card on which room is being made for this member."""
    planned = {} if lease.gang is None else lease.gang.planned
    return next((gpu_id for gpu_id, some in planned.items() if lease in some), None)


def as_waiter(gpu: Gpu, lease: Lease) -> Lease:
    """Itself; of a gang that waits, all that are to come to this card, or may come to no other, as one."""
    gang = lease.gang
    if gang is None or gang.phase != "waiting":
        return lease
    planned = gang.planned.get(gpu.info.id, [])
    some = [one for one in gang.waiting() if one in planned]
    alone = (gpu.info.id,)
    return _bundle(
        gang, some or [one for one in gang.waiting() if one is lease or one.gpus == alone]
    )


def kept_bytes(gpu: Gpu, lease: Lease) -> int:
    """What is charged already for a member that waits for its turn, with the headroom of who loads next."""
    if lease.gang is None or lease.id not in gpu.ledger.reserved:
        return 0
    return _approved(gpu, lease.id) + _approved(gpu, lease.gang.headroom_id)


def outlook(gang: Gang, lease: Lease) -> str:
    """What a member waits for, in words."""
    if gang.phase == "gathering":
        return (
            f"waits for the rest of gang {gang.name}: {len(gang.members)} of {gang.size} have come"
        )
    if gang.phase == "loading":
        return (
            lease.reason
            or f"its bytes are kept for it; it loads when those of gang {gang.name} before it are ready"
        )
    return f"waits as one of gang {gang.name}: {lease.reason or 'behind others'}"


def unfinished(gang: Gang, lease: Lease) -> str:
    """What a granted member's gang still lacks, in words."""
    others = [one for one in gang.members if one is not lease and one.state is not LeaseState.HELD]
    lacks = [f"{one.spec.consumer} ({one.id}) is {one.state}" for one in others]
    missing = gang.size - len(gang.members)
    lacks += [f"{missing} of {gang.size} have to come back"] if missing else []
    return f"gang {gang.name} is complete once {'all are' if lacks else 'it is'} held" + (
        f": {', '.join(lacks)}" if lacks else ""
    )


def unsound(core: Core) -> str:
    """Where a gang that the event can have changed is neither wholly charged nor wholly not; "" if nowhere. For the invariants."""
    for gang in _concerned(core):
        for lease in gang.waiting():
            charged = lease.gpu is not None and core.gpus[lease.gpu].ledger.charges(lease.id)
            if charged != (gang.phase == "loading"):
                return f"gang {gang.name} is {gang.phase}, and {lease.id} is {'charged' if charged else 'not charged'}"
    return ""
