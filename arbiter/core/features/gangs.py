"""Gangs: leases that are granted together or not at all, on one GPU or several.

A gang passes through three phases:
  1. gathering: until all its members have asked; none of them is in a queue
  2. waiting: as one request, with the priority of its lowest member, aged from its first
  3. loading: it fits. Every member's steady bytes are charged at once, and on each GPU the largest
     headroom that one member needs on top while it loads. Members load one after the other per
     GPU, and nothing else is granted there meanwhile.
When all members are held the gang is complete, and they are leases like any other. If a member
ends before that, the gang is broken: waiting members are denied, granted ones keep what they have.
"""

from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, replace
from functools import partial

from vram_arbiter.arbiter.core import eviction
from vram_arbiter.arbiter.core.events import AcquireRequested
from vram_arbiter.arbiter.core.features.gang import (
    Gang,
    Placement,
    approved_bytes,
    clash,
    needs,
    place,
)
from vram_arbiter.arbiter.core.hooks import Feature, Group
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import EXPIRING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.arbiter.core.model.refusals import GangEnd, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.arbiter.core.report.why import Standing
from vram_arbiter.arbiter.core.requests import requests
from vram_arbiter.arbiter.core.requests.requests import known_by
from vram_arbiter.arbiter.core.scheduling import admission, grants, victims
from vram_arbiter.schemas import defaults
from vram_arbiter.schemas.wire.codes import Block, Wait
from vram_arbiter.schemas.wire.explained import Because
from vram_arbiter.schemas.wire.views import LeaseView

_STANDING = frozenset({LeaseState.QUEUED, LeaseState.LOADING, LeaseState.HELD})
"""States of a member that do not break its gang."""


@dataclass(slots=True)
class Gangs(Feature):
    """Gangs that are neither complete nor broken."""

    by_name: dict[str, Gang] = field(default_factory=dict)
    touched: set[str] = field(default_factory=set)  # a member came or moved since `settle`
    settled: set[str] = field(default_factory=set)  # examined by the last `settle`

    live: Mapping[str, Gang] = field(init=False, repr=False)

    def __post_init__(self) -> None:
        self.live = self.by_name

    # -- 1. gathering ------------------------------------------------------------------------------
    def acquire(self, core: Core, event: AcquireRequested, name: str, size: int) -> Lease | None:
        """Keep a member out of the queues until all have asked.

        A member that can never be granted breaks its gang. Raises Refused, also for a member too
        many, or one that says another size.
        """
        gang = self.by_name.get(name)
        full = gang is not None and (gang.size != size or len(gang.members) >= gang.size)
        if gang is not None and full and known_by(core, event) is None:
            raise Refused(no.GangMismatch(name, gang.size, size))
        try:
            request = requests.acquire(core, event)
        except Refused as refused:
            never_fits = isinstance(refused.refusal, no.UnknownGpu | no.TooLarge)
            if gang is not None and gang.phase == "gathering" and never_fits:
                self._break(core, gang, GangEnd.REFUSED, because=refused.refusal.code)
            raise
        if request is None:  # a repeat
            return None
        gang = self._join(core, request, name, size)
        core.enqueue(request, hold_back=True)
        if len(gang.members) == gang.size:
            self._complete(core, gang)
        return request

    def _join(self, core: Core, lease: Lease, name: str, size: int) -> Gang:
        gang = self.by_name.setdefault(name, Gang(name, self, size, core.now))
        self.watch(lease)
        gang.members.append(lease)
        lease.request.group = gang
        self.touched.add(name)
        return gang

    def _complete(self, core: Core, gang: Gang) -> None:
        """All members have asked: queue them as one, or deny all if they can never fit together."""
        waiting = gang.waiting()

        def ever_fits(gpu: Gpu, some: list[Lease]) -> bool:
            """Return whether members fit once every lease but their own gang's has ended."""
            staying = [lease for lease in gpu.residents.values() if lease.request.group is gang]
            if clash([*some, *staying]):
                return False
            fixed = sum(gpu.ledger.charge_bytes(lease.id) for lease in staying)
            return fixed + sum(needs(some).values()) <= gpu.ledger.budget_bytes

        if not place(core, waiting, ever_fits):
            needed = sum(needs(waiting).values())
            budgets = {str(gpu.info.id): gpu.ledger.budget_bytes for gpu in core.gpus.values()}
            self._deny(core, gang, no.GangTooLarge(gang.name, len(waiting), needed, budgets))
            return
        gang.phase = "waiting"
        ageing_s = core.settings.ageing_s_per_point
        for lease in waiting:
            lease.request.rank = gang.first_at - gang.priority * ageing_s
            core.enqueue(lease)

    # -- 2. waiting --------------------------------------------------------------------------------
    def serve(self, core: Core, gpu: Gpu, group: Group) -> None:
        """Grant the next member of the gang that loads on a GPU, or serve the gang of its head."""
        gang = self.by_name[group.name]
        if gpu.keeper is None:
            self._serve_waiting(core, gpu, gang)
        elif core.serving:
            self._load_next(core, gpu, gang)

    def _serve_waiting(self, core: Core, gpu: Gpu, gang: Gang) -> None:
        """Grant all members if all fit, else revoke the victims that let all of them in."""
        waiting = gang.waiting()
        if fitting := place(core, waiting, partial(_fits, core, gang)):
            waits: list[Wait] = []
            for gpu, some in fitting:  # every GPU that lacks a reading is read
                if (wait := grants.measured_wait(core, gpu, gang.bundle(some))) is not None:
                    waits.append(wait)
                    _say(some, wait)
                if wait is Wait.NOT_FREE:
                    gpu.blocked = Block.NOT_FREE
            if not waits:
                self._admit(core, gang, fitting)
            return
        planned = [(gpu, [one for one in some if one in waiting]) for gpu, some in gang.planned]
        planned = [(gpu, some) for gpu, some in planned if some]
        if not planned or not all(_can_make_room(core, gang, *place) for place in planned):
            planned = place(core, waiting, partial(_can_make_room, core, gang))
        gang.planned = planned
        _say(waiting, Wait.MAKING_ROOM if planned else Wait.NO_VICTIM)
        if not planned:
            victims.wake_when_evictable(core, gpu, gang.bundle(waiting))
        for gpu, some in planned:
            for victim in _in_the_way(core, gang, gpu, some) or ():
                eviction.ask(core, gpu, victim, some[0])

    def _admit(self, core: Core, gang: Gang, placement: Placement) -> None:
        """Charge all members at once: from now on each has its bytes, whichever loads first."""
        gang.phase, gang.planned = "loading", []
        for gpu, some in placement:
            gpu.keeper = gang
            for lease in some:
                core.unqueued[lease.id] = lease
                for gpu_id in lease.request.gpus:
                    core.gpus[gpu_id].queue.discard(lease)
                    core.wake(core.gpus[gpu_id])
                lease.request.gpus, lease.request.reason = (gpu.info.id,), None
            gang.admit(gpu, some, core.now)
            core.wake(gpu)
        core.note(gang.note("loading"))

    # -- 3. loading --------------------------------------------------------------------------------
    def _load_next(self, core: Core, gpu: Gpu, gang: Gang) -> None:
        """Grant the next member on a GPU, one load at a time.

        Its bytes are charged already. Still it loads only while its load peak fits: its gang is
        broken if a member or other holders have grown beyond what they were granted.
        """
        share = gang.shares[gpu.info.id]
        lease = next((one for one in share.members if one.state is LeaseState.QUEUED), None)
        unreadable = gpu.failed_at is not None or gpu.sample is None
        if lease is None or unreadable or gpu.in_state(LeaseState.LOADING):
            return
        ledger, budget_bytes = gpu.ledger, gpu.ledger.budget_bytes
        more = lease.request.load_peak_bytes - lease.request.steady_bytes
        headroom = approved_bytes(gpu, gang.headroom_id)
        extra = max(0, more - headroom)
        if ledger.approved_bytes + extra > budget_bytes:
            self._break(core, gang, GangEnd.MEMBER_TOO_LARGE)
            return
        over = ledger.total_bytes() + extra - budget_bytes
        if over > 0:
            self._relieve(core, gpu, gang, lease, over)
            return
        # the headroom is charged to one member's process, and may cover the rest of its load peak
        moved = min(headroom, more)
        total = ledger.total_if_moved(gang.headroom_id, moved, lease.process) if moved else 0
        if self._is_free(core, gpu, gang, lease, crowded=total + extra > budget_bytes):
            gang.set_headroom(gpu, max(0, headroom - more), core.now)
            grants.grant(core, gpu, lease)

    def _relieve(self, core: Core, gpu: Gpu, gang: Gang, lease: Lease, over: int) -> None:
        """Revoke holders that have grown since the gang was admitted, or break it."""
        going = admission.leaving(gpu)
        chosen = [] if going else victims.choose_relief(core, gpu, going, over)
        for victim in chosen:
            eviction.ask(core, gpu, victim, lease)
        if not going and not chosen:
            self._break(core, gang, GangEnd.OTHERS_TOO_LARGE)

    def _is_free(self, core: Core, gpu: Gpu, gang: Gang, lease: Lease, *, crowded: bool) -> bool:
        """Return whether readings show a member's bytes as free.

        The member before needed some of them while it loaded. If they do not come back in time the
        gang is broken: it must not keep the GPU from other requests forever.
        """
        share = gang.shares[gpu.info.id]
        wait = grants.measured_wait(core, gpu, lease, crowded=crowded)
        if wait is None:
            share.short_since = None
            return True
        lease.request.reason = wait
        if wait is not Wait.READING:
            share.short_since = core.now if share.short_since is None else share.short_since
            if core.now - share.short_since > core.settings.verify_timeout_s:
                self._break(core, gang, GangEnd.NOT_FREED)
            else:
                core.read_again(gpu, core.settings.probe_load_s)
        return False

    # -- the end -----------------------------------------------------------------------------------
    def on_moved(self, core: Core, lease: Lease, before: LeaseState) -> None:
        """Examine the gang of a member that came to another state."""
        if lease.request.group is not None:
            self.touched.add(lease.request.group.name)

    def settle(self, core: Core) -> None:
        """Break the gangs of members that ended or leave; finish those with all members held."""
        keepers = [gpu.keeper for gpu in core.gpus.values() if gpu.keeper is not None]
        self.settled = self.touched | {gang.name for gang in keepers}
        self.touched = set()
        for gang in self._named(self.settled):
            states = {one.state for one in gang.members}
            if not states <= _STANDING:
                fallen = next(one for one in gang.members if one.state not in _STANDING)
                ended = core.ended.get(fallen.id)
                because = "" if ended is None or ended.error is None else ended.error.code
                who = (fallen.spec.consumer, fallen.id, str(fallen.state), because)
                self._deny(core, gang, no.BrokenGang(gang.name, GangEnd.FALLEN, *who))
            elif len(gang.members) == gang.size and states == {LeaseState.HELD}:
                self._dissolve(core, gang)
                core.note(gang.note("complete"))
            else:
                for gpu in [core.gpus[gpu_id] for gpu_id in gang.shares]:
                    if gang.trim(gpu, core.now):
                        core.wake(gpu)

    def _named(self, names: Iterable[str]) -> list[Gang]:
        found = [self.by_name[name] for name in names if name in self.by_name]
        return sorted(found, key=lambda gang: (gang.first_at, gang.name))

    def _break(self, core: Core, gang: Gang, why: GangEnd, because: str = "") -> None:
        self._deny(core, gang, no.BrokenGang(gang.name, why, because=because))

    def _deny(self, core: Core, gang: Gang, refusal: no.BrokenGang | no.GangTooLarge) -> None:
        """Deny the waiting members of a gang, and forget it."""
        waiting = [lease for lease in gang.waiting() if lease.id in core.waiting]
        self._dissolve(core, gang)
        core.note(gang.note("broken", refusal))
        for lease in waiting:
            eviction.deny(core, lease, refusal)

    def _dissolve(self, core: Core, gang: Gang) -> None:
        """Forget a gang and withdraw what is reserved for it."""
        self.by_name.pop(gang.name, None)
        core.timers.cancel(("gang", gang.name))
        for lease in gang.members:
            lease.request.group = None
        for gpu in [core.gpus[gpu_id] for gpu_id in gang.shares]:
            gang.withdraw(gpu, core.now)
            gpu.keeper = None
            core.wake(gpu)
        for lease in gang.members:
            if lease.state in EXPIRING:
                core.record_lease(lease)  # a restart must not wait for the rest of the gang

    # -- across a restart --------------------------------------------------------------------------
    def to_record(self, lease: Lease, record: LeaseRecord) -> LeaseRecord:
        """Name the gang of a granted member."""
        gang = _gang_of(lease)
        return record if gang is None else replace(record, gang=(gang.name, gang.size))

    def from_record(self, core: Core, lease: Lease, record: LeaseRecord) -> None:
        """Take a granted member back.

        The others ask again, by their nonces, within the time that a holder has to reattach.
        """
        if record.gang is None or lease.state not in EXPIRING:
            return
        name, size = record.gang
        self._join(core, lease, name, size)
        patience_s = defaults.LEASE_TTL_S + core.settings.fence_grace_s
        core.timers.set(("gang", name), core.now + patience_s)

    def on_gang_due(self, core: Core, name: str) -> None:
        """Break a gang whose other members did not ask again after a restart."""
        gang = self.by_name.get(name)
        if gang is not None and gang.phase == "gathering":
            self._break(core, gang, GangEnd.INCOMPLETE)

    # -- reports and invariants --------------------------------------------------------------------
    def check(self, core: Core) -> None:
        """Check invariant 8: all waiting members of a gang are charged, or none."""
        for gang in self._named(self.settled | self.touched):
            for lease in gang.waiting():
                charged = lease.gpu is not None and lease.id in core.gpus[lease.gpu].ledger.charges
                if charged != (gang.phase == "loading"):
                    told = "charged" if charged else "not charged"
                    raise InvariantViolation(
                        8, f"gang {gang.name} is {gang.phase}, and {lease.id} is {told}"
                    )

    def view(self, shown: LeaseView, lease: Lease) -> LeaseView:
        """Show the gang of a member."""
        gang = _gang_of(lease)
        return shown if gang is None else replace(shown, gang=gang.view())

    def standing(self, core: Core, lease: Lease) -> Standing | None:
        """Tell how a member waits with its gang, or what a granted one's gang still lacks."""
        gang = _gang_of(lease)
        if gang is None:
            return None
        gpu_id = gang.gpu_of(lease)
        gpu, share = core.gpus[gpu_id], gang.shares.get(gpu_id)
        lacking = [one for one in gang.members if one.state is not LeaseState.HELD]
        before = lacking[: lacking.index(lease) + 1] if lease in lacking else []
        queued = gang.phase == "waiting" and lease.state is LeaseState.QUEUED
        gives_up: tuple[float, Because] | None = None
        if gang.phase == "gathering":
            due_at = core.timers.get(("gang", gang.name))
            gives_up = None if due_at is None else (due_at, Because.INCOMPLETE)
        elif share is not None and share.short_since is not None:
            gives_up = share.short_since + core.settings.verify_timeout_s, Because.SHORT
        reserved_bytes = 0
        if lease.id in gpu.ledger.reserved:
            reserved_bytes = approved_bytes(gpu, lease.id) + approved_bytes(gpu, gang.headroom_id)
        return Standing(
            gpu=gpu,
            request=gang.as_waiter(gpu, lease) if queued else lease,
            gang=gang.view(),
            lacks=tuple(one for one in lacking if one is not lease),
            fellows=tuple(gang.waiting()) if queued else (lease,),
            loads=None
            if gang.phase == "gathering"
            else tuple(one for one in before if gang.gpu_of(one) == gpu_id),
            reserved_bytes=reserved_bytes,
            gives_up=gives_up,
        )


def _gang_of(lease: Lease) -> Gang | None:
    group = lease.request.group
    return group if isinstance(group, Gang) else None


def _say(some: Iterable[Lease], reason: Wait) -> None:
    for lease in some:
        lease.request.reason = reason


def _may_share(core: Core, gang: Gang, gpu: Gpu, some: list[Lease]) -> bool:
    """Return whether a GPU serves this gang now, and members can share it."""
    front = admission.front(core, gpu)
    mine = front is not None and front.request.group is gang
    return mine and not admission.blocked(core, gpu) and not clash(some)


def _fits(core: Core, gang: Gang, gpu: Gpu, some: list[Lease]) -> bool:
    return _may_share(core, gang, gpu, some) and admission.fits(gpu, gang.bundle(some))


def _can_make_room(core: Core, gang: Gang, gpu: Gpu, some: list[Lease]) -> bool:
    return _in_the_way(core, gang, gpu, some) is not None


def _in_the_way(core: Core, gang: Gang, gpu: Gpu, some: list[Lease]) -> list[Lease] | None:
    """Return the holders to revoke so that members fit; None: no room can be made."""
    if not _may_share(core, gang, gpu, some) or admission.residue_under_measurement(gpu):
        return None
    going, bundle = admission.leaving(gpu), gang.bundle(some)
    if admission.fits(gpu, bundle, going):
        return []
    return victims.choose_victims(core, gpu, bundle, going)
