"""Gangs: leases that are granted together or not at all, on one GPU or several.

A gang passes through three phases:
  gathering: until all its members have asked; none of them is in a queue
  waiting: as one request, with the priority of its lowest member, aged from its first
  loading: it fits. Every member's steady bytes are charged at once, and on each GPU the largest
    headroom that one member needs on top while it loads. Members load one after the other per
    GPU, and nothing else is granted there meanwhile.
When all members are held the gang is complete, and they are leases like any other. If a member
ends before that, the gang is broken: waiting members are denied, granted ones keep what they have.
"""

from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from typing import Any

from vram_arbiter.arbiter.core.events import AcquireRequested, LeaseSpec
from vram_arbiter.arbiter.core.eviction import eviction
from vram_arbiter.arbiter.core.hooks import Feature
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.lease import EXPIRING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import GangEnd, Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.report.standing import Standing
from vram_arbiter.arbiter.core.scheduling import admission, grants, placement, victims
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block, Wait
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.explained import Because
from vram_arbiter.schemas.wire.views import GangView

SEARCH_MAX = 4096
"""Placements to examine. A gang with more possible ones may wait although one of them fits."""

_STANDING = frozenset({LeaseState.QUEUED, LeaseState.LOADING, LeaseState.HELD})
"""States of a member that do not break its gang."""

type _Placement = dict[GpuId, list[Lease]]


@dataclass(slots=True)
class Gang:
    """One gang, until it is complete or broken."""

    name: str
    size: int
    first_at: float
    phase: str = "gathering"  # → waiting → loading
    members: list[Lease] = field(default_factory=list)
    planned: _Placement = field(default_factory=dict)  # where room is being made
    gpus: list[GpuId] = field(default_factory=list)  # loading: where its bytes are charged
    reserved_bytes: dict[GpuId, int] = field(default_factory=dict)  # admitted there
    short_since: dict[GpuId, float] = field(default_factory=dict)  # readings show less free

    def waiting(self) -> list[Lease]:
        """Return the members that are not granted yet."""
        return [lease for lease in self.members if lease.state is LeaseState.QUEUED]

    def waiting_on(self, gpu: Gpu) -> list[Lease]:
        """Return the members whose bytes are charged on a GPU and that have not begun to load."""
        return [lease for lease in self.waiting() if lease.gpu == gpu.info.id]

    @property
    def priority(self) -> int:
        """The lowest priority of its members."""
        return min(lease.spec.priority for lease in self.members)

    @property
    def headroom_id(self) -> LeaseId:
        """Ledger entry of what the next member needs on top of its steady bytes while it loads."""
        return LeaseId(f"gang:{self.name}")

    def view(self) -> GangView:
        """Return how reports show it."""
        return GangView(self.name, self.phase, len(self.members), self.size)

    def planned_on(self, lease: Lease) -> GpuId | None:
        """Return the GPU on which room is being made for a member."""
        return next((gpu_id for gpu_id, some in self.planned.items() if lease in some), None)


@dataclass(slots=True)
class Gangs(Feature):
    """Gangs that are neither complete nor broken."""

    by_name: dict[str, Gang] = field(default_factory=dict)
    of: dict[LeaseId, Gang] = field(default_factory=dict)  # by member
    loading: dict[GpuId, Gang] = field(default_factory=dict)  # a GPU serves one gang at a time
    touched: set[str] = field(default_factory=set)  # a member came or moved since `settle`
    settled: set[str] = field(default_factory=set)  # examined by the last `settle`

    timers = frozenset({"gang"})

    # -- gathering ---------------------------------------------------------------------------------
    def on_acquire(self, core: Core, event: AcquireRequested, known: Lease | None) -> bool:
        """Refuse a member too many, or one that says another size."""
        if known is not None or event.spec.gang is None:
            return False
        name, size = event.spec.gang
        gang = self.by_name.get(name)
        if gang is None:
            return False
        if gang.size != size:
            raise Refused(no.GangMismatch(name, gang.size, size))
        if len(gang.members) >= gang.size:
            raise Refused(no.GangMismatch(name, gang.size, size))
        return False

    def on_refused(self, core: Core, spec: LeaseSpec, refusal: Refusal) -> None:
        """Break the gang of a refused member: it can never be complete."""
        gang = None if spec.gang is None else self.by_name.get(spec.gang[0])
        if gang is not None and gang.phase == "gathering":
            broken = no.BrokenGang(gang.name, GangEnd.REFUSED, because=refusal.code)
            self._break(core, gang, broken)

    def on_request(self, core: Core, request: Lease) -> bool:
        """Keep a member out of the queues until all have asked."""
        if request.spec.gang is None:
            return False
        gang = self._join(core, request, *request.spec.gang)
        core.hold_back(request)
        if len(gang.members) == gang.size:
            self._complete(core, gang)
        return True

    def _join(self, core: Core, lease: Lease, name: str, size: int) -> Gang:
        gang = self.by_name.setdefault(name, Gang(name, size, core.now))
        self.watch(lease)
        gang.members.append(lease)
        self.of[lease.id] = gang
        self.touched.add(name)
        return gang

    def _complete(self, core: Core, gang: Gang) -> None:
        """All members have asked: queue them as one, or deny all if they can never fit together."""
        waiting = gang.waiting()
        if not _place(core, waiting, lambda gpu, some: self._ever_fits(gang, gpu, some)):
            needed = sum(_needs(waiting).values())
            budgets = {str(gpu.info.id): gpu.ledger.budget_bytes for gpu in core.gpus.values()}
            self._break(core, gang, no.GangTooLarge(gang.name, len(waiting), needed, budgets))
            return
        gang.phase = "waiting"
        ageing_s = core.settings.ageing_s_per_point if core.settings.scheduling.by_priority else 0.0
        for lease in waiting:
            lease.request.rank = gang.first_at - gang.priority * ageing_s
            for gpu_id in lease.request.gpus:
                core.gpus[gpu_id].queue.add(lease)
                core.wake(core.gpus[gpu_id])

    def _ever_fits(self, gang: Gang, gpu: Gpu, some: list[Lease]) -> bool:
        """Return whether members would fit if every lease ended but those of their own gang."""
        staying = [lease for lease in gpu.residents.values() if self.of.get(lease.id) is gang]
        alone = any(one.spec.exclusive for one in [*some, *staying])
        if alone and len(some) + len(staying) > 1:
            return False
        fixed = sum(gpu.ledger.charge_bytes(lease.id) for lease in staying)
        return fixed + sum(_needs(some).values()) <= gpu.ledger.budget_bytes

    # -- waiting -----------------------------------------------------------------------------------
    def owns(self, request: Lease) -> bool:
        """Return whether a request is granted by `serve` alone."""
        return request.id in self.of

    def serve(self, core: Core, gpu: Gpu, head: Lease | None) -> None:
        """Grant the next member of the gang that loads on a GPU, or serve the gang of its head."""
        loading = self.loading.get(gpu.info.id)
        if loading is not None:
            member = None if core.recovering is not None else self._next_load(core, gpu, loading)
            if member is not None:
                grants.grant(core, gpu, member)
        elif head is not None:
            self._serve_waiting(core, gpu, self.of[head.id])

    def _serve_waiting(self, core: Core, gpu: Gpu, gang: Gang) -> None:
        """Grant all members if all fit, else revoke the victims that let all of them in."""
        waiting = gang.waiting()
        fitting = _place(core, waiting, lambda gpu, some: self._fits(core, gpu, gang, some))
        if fitting:
            readings = [_has_room(core, gpu, gang, some) for gpu, some in _by_gpu(core, fitting)]
            if all(readings):
                self._admit(core, gang, fitting)
            return
        placement = self._plan(core, gang)
        if placement is None:
            _say(waiting, Wait.NO_VICTIM)
            victims.wake_when_evictable(core, gpu, _bundle(gang, waiting))
            return
        _say(waiting, Wait.MAKING_ROOM)
        for gpu, some in _by_gpu(core, placement):
            bundle, going = _bundle(gang, some), admission.leaving(gpu)
            if admission.fits(gpu, bundle, going):
                continue
            for victim in victims.choose_victims(core, gpu, bundle, going) or ():
                eviction.ask(core, gpu, victim, some[0])

    def _plan(self, core: Core, gang: Gang) -> _Placement | None:
        """Return where room can be made for all waiting members, preferably where it is made."""
        waiting = gang.waiting()

        def possible(gpu: Gpu, some: list[Lease]) -> bool:
            return self._can_be_made(core, gpu, gang, some)

        planned = {
            gpu: [one for one in some if one in waiting] for gpu, some in gang.planned.items()
        }
        if not planned or not all(possible(gpu, some) for gpu, some in _by_gpu(core, planned)):
            planned = _place(core, waiting, possible) or {}
        gang.planned = planned
        return planned or None

    def _is_next(self, core: Core, gpu: Gpu, gang: Gang) -> bool:
        front = placement.front(core, gpu)
        return (
            front is not None and self.of.get(front.id) is gang and not admission.blocked(core, gpu)
        )

    def _fits(self, core: Core, gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
        return (
            self._is_next(core, gpu, gang)
            and not _clash(some)
            and admission.fits(gpu, _bundle(gang, some))
        )

    def _can_be_made(self, core: Core, gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
        if (
            not self._is_next(core, gpu, gang)
            or _clash(some)
            or admission.residue_under_measurement(gpu)
        ):
            return False
        going, bundle = admission.leaving(gpu), _bundle(gang, some)
        return (
            admission.fits(gpu, bundle, going)
            or victims.choose_victims(core, gpu, bundle, going) is not None
        )

    # -- loading -----------------------------------------------------------------------------------
    def _admit(self, core: Core, gang: Gang, placement: _Placement) -> None:
        """Charge all members at once: from now on each has its bytes, whichever loads first."""
        gang.phase, gang.planned = "loading", {}
        for gpu, some in _by_gpu(core, placement):
            gang.gpus.append(gpu.info.id)
            self.loading[gpu.info.id] = gang
            gpu.keeper = self
            for lease in some:
                for gpu_id in lease.request.gpus:
                    core.gpus[gpu_id].queue.discard(lease)
                    core.wake(core.gpus[gpu_id])
                lease.request.gpus, lease.gpu, lease.request.reason = (
                    (gpu.info.id,),
                    gpu.info.id,
                    None,
                )
                gpu.ledger.reserve(lease.id, lease.process, lease.request.steady_bytes, core.now)
            _set_headroom(core, gpu, gang, _headroom_bytes(some))
            here = [one.id for one in gang.members if one.gpu == gpu.info.id]
            gang.reserved_bytes[gpu.info.id] = sum(
                _approved(gpu, one) for one in [*here, gang.headroom_id]
            )
            core.wake(gpu)
        _note(core, gang, "loading")

    def blocks(self, gpu: Gpu) -> str:
        """Return the name of the gang that loads on a GPU."""
        return self.loading[gpu.info.id].name

    def _next_load(self, core: Core, gpu: Gpu, gang: Gang) -> Lease | None:
        lease = next(iter(gang.waiting_on(gpu)), None)
        if (
            lease is None
            or gpu.failed_at is not None
            or gpu.sample is None
            or gpu.in_state(LeaseState.LOADING)
        ):
            return None
        more = lease.request.load_peak_bytes - lease.request.steady_bytes
        headroom = _approved(gpu, gang.headroom_id)
        extra = max(0, more - headroom)
        if gpu.ledger.approved_bytes() + extra > gpu.ledger.budget_bytes:
            self._break(core, gang, no.BrokenGang(gang.name, GangEnd.MEMBER_TOO_LARGE))
            return None
        over = gpu.ledger.total_bytes() + extra - gpu.ledger.budget_bytes
        if over > 0:
            self._relieve(core, gpu, gang, lease, over)
            return None
        # the headroom is charged to one member's process, and may cover the rest of its load peak
        moved = min(headroom, more)
        total = gpu.ledger.total_if_moved(gang.headroom_id, moved, lease.process) if moved else 0
        crowded = total + extra > gpu.ledger.budget_bytes
        if not self._is_free(core, gpu, gang, lease, crowded=crowded):
            return None
        _set_headroom(core, gpu, gang, max(0, headroom - more))
        return lease

    def _relieve(self, core: Core, gpu: Gpu, gang: Gang, lease: Lease, over: int) -> None:
        """Revoke holders that have grown since the gang was admitted, or break it."""
        going = admission.leaving(gpu)
        chosen = [] if going else victims.choose_relief(core, gpu, going, over)
        for victim in chosen:
            eviction.ask(core, gpu, victim, lease)
        if not going and not chosen:
            self._break(core, gang, no.BrokenGang(gang.name, GangEnd.OTHERS_TOO_LARGE))

    def _is_free(self, core: Core, gpu: Gpu, gang: Gang, lease: Lease, *, crowded: bool) -> bool:
        """Return whether readings show a member's bytes as free.

        The member before needed some of them while it loaded. If they do not come back in time the
        gang is broken: it must not keep the GPU from other requests forever.
        """
        room = admission.measured_room_bytes(core, gpu)
        if not crowded and room is not None and room >= admission.measured_need_bytes(gpu, lease):
            gang.short_since.pop(gpu.info.id, None)
            return True
        if room is None or admission.sample_is_behind(gpu):
            _want_reading(core, gpu, [lease])
            return False
        lease.request.reason = Wait.NOT_FREE
        since = gang.short_since.setdefault(gpu.info.id, core.now)
        if core.now - since > core.settings.verify_timeout_s:
            self._break(core, gang, no.BrokenGang(gang.name, GangEnd.NOT_FREED))
        else:
            core.read_again(gpu, core.settings.load_probe_s)
        return False

    # -- the end -----------------------------------------------------------------------------------
    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Examine the gang of a member that came to another state."""
        gang = self.of.get(lease.id)
        if gang is not None:
            self.touched.add(gang.name)

    def settle(self, core: Core) -> None:
        """Break the gangs of members that ended or leave; finish those with all members held."""
        if not self.by_name:
            return
        self.settled = self.touched | {gang.name for gang in self.loading.values()}
        self.touched = set()
        for gang in self._named(self.settled):
            fallen = next((one for one in gang.members if one.state not in _STANDING), None)
            if fallen is not None:
                ended = core.ended.get(fallen.id)
                because = "" if ended is None or ended.error is None else ended.error.code
                who = (fallen.spec.consumer, fallen.id, str(fallen.state), because)
                self._break(core, gang, no.BrokenGang(gang.name, GangEnd.FALLEN, *who))
            elif len(gang.members) == gang.size and all(
                one.state is LeaseState.HELD for one in gang.members
            ):
                self._dissolve(core, gang)
                _note(core, gang, "complete")
            elif gang.phase == "loading":
                for gpu_id in gang.gpus:
                    _trim(core, core.gpus[gpu_id], gang)

    def _named(self, names: Iterable[str]) -> list[Gang]:
        found = [self.by_name[name] for name in names if name in self.by_name]
        return sorted(found, key=lambda gang: (gang.first_at, gang.name))

    def _break(self, core: Core, gang: Gang, refusal: no.BrokenGang | no.GangTooLarge) -> None:
        waiting = [lease for lease in gang.waiting() if lease.id in core.waiting]
        self._dissolve(core, gang)
        _note(core, gang, "broken", refusal)
        for lease in waiting:
            eviction.deny(core, lease, refusal)

    def _dissolve(self, core: Core, gang: Gang) -> None:
        """Forget a gang and withdraw what is reserved for it."""
        self.by_name.pop(gang.name, None)
        core.timers.clear(("gang", gang.name))
        for lease in gang.members:
            self.of.pop(lease.id, None)
        for gpu_id in gang.gpus:
            gpu = core.gpus[gpu_id]
            for lease in gang.members:
                if lease.id in gpu.ledger.reserved:
                    gpu.ledger.withdraw(lease.id, core.now)
                    lease.gpu = None
            _set_headroom(core, gpu, gang, 0)
            del self.loading[gpu_id]
            gpu.keeper = None
            core.wake(gpu)
        for lease in gang.members:
            if lease.state in EXPIRING:
                core.record_lease(lease)  # a restart must not wait for the rest of the gang

    # -- across a restart --------------------------------------------------------------------------
    def to_record(self, lease: Lease) -> Mapping[str, Any]:
        """Name the gang of a granted member."""
        gang = self.of.get(lease.id)
        return {} if gang is None else {"gang": [gang.name, gang.size]}

    def from_record(self, core: Core, lease: Lease, record: Mapping[str, Any]) -> None:
        """Take a granted member back.

        The others ask again, by their nonces, within the time that a holder has to reattach.
        """
        if record.get("gang") is None or lease.state not in EXPIRING:
            return
        name, size = record["gang"]
        self._join(core, lease, str(name), int(size))
        patience_s = defaults.LEASE_TTL_S + core.settings.fence_grace_s
        core.timers.set(("gang", str(name)), core.now + patience_s)

    def on_timer(self, core: Core, kind: str, subject: str) -> None:
        """Break a gang whose other members did not ask again after a restart."""
        gang = self.by_name.get(subject)
        if gang is not None and gang.phase == "gathering":
            self._break(core, gang, no.BrokenGang(gang.name, GangEnd.INCOMPLETE))

    # -- answers -----------------------------------------------------------------------------------
    def protects(self, lease: Lease) -> str:
        """A member is not revoked before its gang is complete."""
        gang = self.of.get(lease.id)
        return "" if gang is None else gang.name

    def unplaced(self) -> Iterator[Lease]:
        """Members that gather or load are in no queue."""
        for gang in self.by_name.values():
            if gang.phase != "waiting":
                yield from gang.waiting()

    def check(self, core: Core, *, everything: bool) -> None:
        """Check invariant 7: all waiting members of a gang are charged, or none."""
        for gang in self._named(self.by_name if everything else self.settled | self.touched):
            for lease in gang.waiting():
                charged = lease.gpu is not None and core.gpus[lease.gpu].ledger.charges(lease.id)
                if charged != (gang.phase == "loading"):
                    told = "charged" if charged else "not charged"
                    raise InvariantViolation(
                        7, f"gang {gang.name} is {gang.phase}, and {lease.id} is {told}"
                    )

    def view(self, core: Core, lease: Lease) -> Mapping[str, object]:
        """Show the gang of a member."""
        gang = self.of.get(lease.id)
        if gang is None:
            return {}
        return {"gang": gang.view()}

    def standing(self, core: Core, lease: Lease) -> Standing | None:
        """Tell how a member waits with its gang, or what a granted one's gang still lacks."""
        gang = self.of.get(lease.id)
        if gang is None:
            return None
        gpu = core.gpus[_gpu_of(gang, lease)]
        mine = [one for one in gang.members if one.state is not LeaseState.HELD]
        before = mine[: mine.index(lease) + 1] if lease in mine else []
        loads = [one for one in before if _gpu_of(gang, one) == gpu.info.id]
        queued = gang.phase == "waiting" and lease.state is LeaseState.QUEUED
        reserved_bytes = 0
        if lease.id in gpu.ledger.reserved:
            reserved_bytes = _approved(gpu, lease.id) + _approved(gpu, gang.headroom_id)
        return Standing(
            gpu=gpu,
            request=_as_waiter(gang, gpu, lease) if queued else lease,
            gang=gang.view(),
            lacks=tuple(_lacking(gang, lease)),
            fellows=tuple(gang.waiting()) if queued else (lease,),
            loads=None if gang.phase == "gathering" else tuple(loads),
            reserved_bytes=reserved_bytes,
            gives_up=_gives_up(core, gang, gpu),
        )


# -- bytes -----------------------------------------------------------------------------------------
def _needs(some: Iterable[Lease]) -> dict[ProcessKey, int]:
    """Return what an admission charges, by process: all steady bytes and the largest headroom."""
    some = list(some)
    needs: dict[ProcessKey, int] = {}
    for lease in some:
        needs[lease.process] = needs.get(lease.process, 0) + lease.request.steady_bytes
    needs[some[0].process] += _headroom_bytes(some)
    return needs


def _headroom_bytes(some: Iterable[Lease]) -> int:
    return max(
        (lease.request.load_peak_bytes - lease.request.steady_bytes for lease in some), default=0
    )


def _bundle(gang: Gang, some: list[Lease]) -> Lease:
    """Return the members on one GPU as a single request."""
    first = some[0]
    exclusive = any(one.spec.exclusive for one in some)
    spec = replace(first.spec, priority=gang.priority, exclusive=exclusive)
    request = replace(first.request, arrived_at=gang.first_at, needs=_needs(some))
    return replace(first, spec=spec, request=request)


def _as_waiter(gang: Gang, gpu: Gpu, lease: Lease) -> Lease:
    """Return the members planned for a GPU, or that may have no other, as a single request."""
    planned = gang.planned.get(gpu.info.id, [])
    some = [one for one in gang.waiting() if one in planned]
    only = (gpu.info.id,)
    return _bundle(
        gang, some or [one for one in gang.waiting() if one is lease or one.request.gpus == only]
    )


def _clash(some: list[Lease]) -> bool:
    return len(some) > 1 and any(one.spec.exclusive for one in some)


def _approved(gpu: Gpu, lease_id: LeaseId) -> int:
    return gpu.ledger.charge_of(lease_id).approved_bytes if gpu.ledger.charges(lease_id) else 0


def _set_headroom(core: Core, gpu: Gpu, gang: Gang, count: int) -> None:
    """Reserve bytes for the member that loads next, charged to one of the gang's processes."""
    if gpu.ledger.charges(gang.headroom_id):
        gpu.ledger.withdraw(gang.headroom_id, core.now)
    if count:
        owner = next(one for one in gang.members if one.gpu == gpu.info.id)
        gpu.ledger.reserve(gang.headroom_id, owner.process, count, core.now)


def _trim(core: Core, gpu: Gpu, gang: Gang) -> None:
    """Between two loads, reserve the next one's headroom out of what is admitted and not held."""
    if gpu.in_state(LeaseState.LOADING):
        return
    here = [one for one in gang.members if one.gpu == gpu.info.id]
    held = sum(_approved(gpu, one.id) for one in here)
    spare = gang.reserved_bytes[gpu.info.id] - held
    wanted = _headroom_bytes([one for one in here if one.state is LeaseState.QUEUED])
    if _approved(gpu, gang.headroom_id) != max(0, min(spare, wanted)):
        _set_headroom(core, gpu, gang, max(0, min(spare, wanted)))
        core.wake(gpu)


# -- readings --------------------------------------------------------------------------------------
def _has_room(core: Core, gpu: Gpu, gang: Gang, some: list[Lease]) -> bool:
    """Return whether a reading shows room for members on a GPU; ask for one if none can."""
    room = admission.measured_room_bytes(core, gpu)
    need = admission.measured_need_bytes(gpu, _bundle(gang, some))
    if room is None or (room < need and admission.sample_is_behind(gpu)):
        _want_reading(core, gpu, some)
        return False
    if room < need:
        gpu.blocked = Block.NOT_FREE
        _say(some, Wait.NOT_FREE)
    return room >= need


def _want_reading(core: Core, gpu: Gpu, some: Iterable[Lease]) -> None:
    _say(some, Wait.READING)
    core.want_sample(gpu, max(gpu.changed_at, core.now - core.settings.sample_max_age_s))


# -- placement -------------------------------------------------------------------------------------
def _place(
    core: Core, members: list[Lease], may: Callable[[Gpu, list[Lease]], bool]
) -> _Placement | None:
    """Return a GPU for every member, or None. `may`: whether some may be on a GPU together.

    Members with the fewest GPUs choose first, then the largest; GPUs are tried in their order.
    """
    order = sorted(
        members,
        key=lambda lease: (
            len(lease.request.gpus),
            -lease.request.load_peak_bytes,
            lease.request.arrival,
        ),
    )
    placement: _Placement = {}
    budget = SEARCH_MAX

    def extend(index: int) -> bool:
        nonlocal budget
        if index == len(order):
            return True
        lease = order[index]
        for gpu_id in lease.request.gpus:
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


def _by_gpu(core: Core, placement: _Placement) -> list[tuple[Gpu, list[Lease]]]:
    return [
        (gpu, placement[gpu.info.id]) for gpu in core.gpus.values() if placement.get(gpu.info.id)
    ]


def _gpu_of(gang: Gang, lease: Lease) -> GpuId:
    """Return where a member is, where room is made for it, or its first candidate."""
    return lease.gpu or gang.planned_on(lease) or lease.request.planned_gpu or lease.request.gpus[0]


# -- reports ---------------------------------------------------------------------------------------
def _note(core: Core, gang: Gang, phase: str, refusal: Refusal | None = None) -> None:
    members = [lease.id for lease in gang.members]
    why: dict[str, Any] = {} if refusal is None else {"refusal": refusal}
    core.note("gang", gang=gang.name, phase=phase, members=members, **why)


def _say(some: Iterable[Lease], reason: Wait) -> None:
    for lease in some:
        lease.request.reason = reason


def _lacking(gang: Gang, lease: Lease) -> list[Lease]:
    """Return the other members that are not held yet."""
    return [one for one in gang.members if one is not lease and one.state is not LeaseState.HELD]


def _gives_up(core: Core, gang: Gang, gpu: Gpu) -> tuple[float, Because] | None:
    """Return when a gang that gathers or loads is broken, and on which condition."""
    if gang.phase == "gathering":
        at = core.timers.due(("gang", gang.name))
        return None if at is None else (at, Because.INCOMPLETE)
    since = gang.short_since.get(gpu.info.id)
    if gang.phase == "waiting" or since is None:
        return None
    return since + core.settings.verify_timeout_s, Because.SHORT
