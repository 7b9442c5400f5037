"""One gang: its members, the bytes charged for them, and where they may be placed.

Knows nothing of its phases' steps (`gangs`) or of other requests.
"""

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace
from typing import Literal

from vram_arbiter.arbiter.core.hooks import Group
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.notes import GangNote
from vram_arbiter.schemas.wire.views import GangView

SEARCH_MAX = 4096
"""Placements to examine. A gang with more possible ones may wait although one of them fits."""

type Placement = list[tuple[Gpu, list[Lease]]]
"""Members by GPU, in the order of the GPUs."""


@dataclass(slots=True)
class Share:
    """Members of a loading gang on one GPU."""

    members: list[Lease]
    admitted_bytes: int  # steady bytes of all of them, and the largest headroom
    short_since: float | None = None  # readings show less free than the next one needs


@dataclass(slots=True)
class Gang(Group):
    """One gang, until it is complete or broken."""

    size: int
    first_at: float
    phase: Literal["gathering", "waiting", "loading"] = "gathering"
    members: list[Lease] = field(default_factory=list)
    planned: Placement = field(default_factory=list)  # waiting: where room is being made
    shares: dict[GpuId, Share] = field(default_factory=dict)  # loading: what is charged where

    @property
    def priority(self) -> int:
        """The lowest priority of its members."""
        return min(lease.spec.priority for lease in self.members)

    @property
    def headroom_id(self) -> LeaseId:
        """Ledger entry of what the next member needs on top of its steady bytes while it loads."""
        return LeaseId(f"gang:{self.name}")

    def waiting(self) -> list[Lease]:
        """Return the members that are not granted yet."""
        return [lease for lease in self.members if lease.state is LeaseState.QUEUED]

    def bundle(self, some: list[Lease]) -> Lease:
        """Return the members on one GPU as a single request."""
        first = some[0]
        mode = "exclusive" if any(one.spec.exclusive for one in some) else first.spec.mode
        spec = replace(first.spec, priority=self.priority, mode=mode)
        request = replace(first.request, arrived_at=self.first_at, needs=needs(some))
        return replace(first, spec=spec, request=request)

    # -- what is charged for it on a GPU
    def admit(self, gpu: Gpu, some: list[Lease], now: float) -> None:
        """Charge the steady bytes of members, and the largest headroom that one of them needs."""
        for lease in some:
            lease.gpu = gpu.info.id
            gpu.ledger.reserve(lease.id, lease.process, lease.request.steady_bytes, now)
        here = [one for one in self.members if one.gpu == gpu.info.id]
        headroom = headroom_bytes(some)
        admitted_bytes = headroom + sum(approved_bytes(gpu, one.id) for one in here)
        self.shares[gpu.info.id] = Share(here, admitted_bytes)
        self.set_headroom(gpu, headroom, now)

    def set_headroom(self, gpu: Gpu, count: int, now: float) -> None:
        """Reserve bytes for the member that loads next, charged to one of the gang's processes."""
        if self.headroom_id in gpu.ledger.charges:
            gpu.ledger.withdraw(self.headroom_id, now)
        if count:
            owner = self.shares[gpu.info.id].members[0]
            gpu.ledger.reserve(self.headroom_id, owner.process, count, now)

    def trim(self, gpu: Gpu, now: float) -> bool:
        """Between two loads, reserve the next one's headroom out of what is admitted and not held.

        Return whether that changed it.
        """
        if gpu.in_state(LeaseState.LOADING):
            return False
        share = self.shares[gpu.info.id]
        spare = share.admitted_bytes - sum(approved_bytes(gpu, one.id) for one in share.members)
        waiting = [one for one in share.members if one.state is LeaseState.QUEUED]
        headroom = max(0, min(spare, headroom_bytes(waiting)))
        if approved_bytes(gpu, self.headroom_id) == headroom:
            return False
        self.set_headroom(gpu, headroom, now)
        return True

    def withdraw(self, gpu: Gpu, now: float) -> None:
        """Take back what is reserved for it and not granted."""
        for lease in self.shares[gpu.info.id].members:
            if lease.id in gpu.ledger.reserved:
                gpu.ledger.withdraw(lease.id, now)
                lease.gpu = None
        self.set_headroom(gpu, 0, now)

    # -- how reports show it
    def view(self) -> GangView:
        """Return how a lease's view shows its gang."""
        return GangView(self.name, self.phase, len(self.members), self.size)

    def note(
        self,
        phase: Literal["loading", "complete", "broken"],
        refusal: no.BrokenGang | no.GangTooLarge | None = None,
    ) -> GangNote:
        """Return the note of what became of it."""
        return GangNote(self.name, phase, tuple(one.id for one in self.members), refusal)

    def gpu_of(self, lease: Lease) -> GpuId:
        """Return where a member is, where room is made for it, or its first candidate."""
        planned = next((gpu.info.id for gpu, some in self.planned if lease in some), None)
        return lease.gpu or planned or lease.request.planned_gpu or lease.request.gpus[0]

    def as_waiter(self, gpu: Gpu, lease: Lease) -> Lease:
        """Return the members planned for a GPU, or that may have no other, as a single request."""
        waiting, only = self.waiting(), (gpu.info.id,)
        planned = [one for there, some in self.planned if there is gpu for one in some]
        some = [one for one in waiting if one in planned]
        return self.bundle(
            some or [one for one in waiting if one is lease or one.request.gpus == only]
        )


def needs(some: list[Lease]) -> dict[ProcessKey, int]:
    """Return what an admission charges, by process: all steady bytes and the largest headroom."""
    found: dict[ProcessKey, int] = {}
    for lease in some:
        found[lease.process] = found.get(lease.process, 0) + lease.request.steady_bytes
    found[some[0].process] += headroom_bytes(some)
    return found


def headroom_bytes(some: Iterable[Lease]) -> int:
    """Return the most that one of these members needs on top of its steady bytes while it loads."""
    requests = [lease.request for lease in some]
    return max([one.load_peak_bytes - one.steady_bytes for one in requests], default=0)


def approved_bytes(gpu: Gpu, lease_id: LeaseId) -> int:
    """Return what fitted of a charge when it was granted or reserved; 0: nothing is charged."""
    charge = gpu.ledger.charges.get(lease_id)
    return 0 if charge is None else charge.approved_bytes


def clash(some: list[Lease]) -> bool:
    """Return whether members cannot share a GPU: one of several is exclusive."""
    return len(some) > 1 and any(one.spec.exclusive for one in some)


def place(core: Core, members: list[Lease], may: Callable[[Gpu, list[Lease]], bool]) -> Placement:
    """Return a GPU for every member; empty: there is none. `may`: whether some may be on a GPU
    together.

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
    placed: dict[GpuId, list[Lease]] = {}
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
            here = placed.setdefault(gpu_id, [])
            here.append(lease)
            if may(core.gpus[gpu_id], here) and extend(index + 1):
                return True
            here.pop()
        return False

    if not extend(0):
        return []
    return [(gpu, some) for gpu in core.gpus.values() if (some := placed.get(gpu.info.id))]
