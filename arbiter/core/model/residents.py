"""Residents of one GPU, with tables of the few that a decision asks about.

A GPU may have ten thousand small leases while one loads and two leave. The tables are kept as
leases change state (`Lease.move` tells its `roster`), so that a decision costs what has changed and
not what is there. Every change comes through `[id] = lease`, `del [id]` or `pop`; `disagreement`
finds what did not. Must not depend on bytes or order.
"""

from collections.abc import Iterable, Iterator

from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.schemas.ids import LeaseId

_MISSING = object()


class Residents(dict[LeaseId, Lease]):
    """Leases of one GPU by id, oldest grant first, with tables by state and by what they forbid."""

    def __init__(self) -> None:
        super().__init__()
        self._by_state: dict[LeaseState, dict[LeaseId, Lease]] = {state: {} for state in LeaseState}
        self.exclusive: dict[LeaseId, Lease] = {}
        self.pinned: dict[LeaseId, Lease] = {}
        """Never revoked: the holder or an operator forbids it."""
        self.recent: dict[LeaseId, Lease] = {}
        """Leases granted, enlarged or ready since the newest reading began; may hold more."""
        self.enlarged: dict[LeaseId, float] = {}
        """When a resident was last granted more bytes."""
        self.touched: set[LeaseId] = set()
        """Leases that came or went since the last check of the invariants."""

    # -- changing
    def __setitem__(self, lease_id: LeaseId, lease: Lease) -> None:
        self.pop(lease_id, None)
        super().__setitem__(lease_id, lease)
        lease.roster = self
        self._by_state[lease.state][lease_id] = lease
        self.recent[lease_id] = lease
        self.touched.add(lease_id)
        if lease.spec.exclusive:
            self.exclusive[lease_id] = lease
        self.refresh(lease)

    def __delitem__(self, lease_id: LeaseId) -> None:
        self.pop(lease_id)

    def pop(self, lease_id: LeaseId, default: object = _MISSING) -> Lease | None:  # type: ignore[override]  # reason: one default
        """Take a lease off the GPU. Raises KeyError without a default, as any dict."""
        lease = self.get(lease_id)
        if lease is None:
            if default is _MISSING:
                raise KeyError(lease_id)
            return None
        super().__delitem__(lease_id)
        lease.roster = None
        for table in (self._by_state[lease.state], self.exclusive, self.pinned, self.recent):
            table.pop(lease_id, None)
        self.enlarged.pop(lease_id, None)
        self.touched.add(lease_id)
        return lease

    def moved(self, lease: Lease, before: LeaseState) -> None:
        """A lease of this GPU came to another state."""
        self._by_state[before].pop(lease.id, None)
        self._by_state[lease.state][lease.id] = lease
        if lease.state is LeaseState.HELD:
            self.recent[lease.id] = lease

    def refresh(self, lease: Lease) -> None:
        """Whether a lease may be revoked has changed."""
        if lease.evictable:
            self.pinned.pop(lease.id, None)
        else:
            self.pinned[lease.id] = lease

    def enlarge(self, lease: Lease, now: float) -> None:
        """A resident was granted more bytes."""
        self.enlarged[lease.id] = now
        self.recent[lease.id] = lease

    def seen(self, taken_at: float) -> None:
        """Forget recent leases that a reading that began at `taken_at` has seen."""
        for lease in [lease for lease in self.recent.values() if not self._after(lease, taken_at)]:
            del self.recent[lease.id]

    # -- reading
    def in_state(self, *states: LeaseState) -> list[Lease]:
        """Leases in these states, in the order in which they came to them."""
        return [lease for state in states for lease in self._by_state[state].values()]

    def any_in(self, states: Iterable[LeaseState]) -> bool:
        by_state = self._by_state
        # asked with every event, and a generator costs more than the answer
        for state in states:  # noqa: SIM110
            if by_state[state]:
                return True
        return False

    def unseen(self, taken_at: float) -> list[Lease]:
        """Return leases granted, enlarged or ready after a reading began: it cannot show their
        bytes.
        """
        return [lease for lease in self.recent.values() if self._after(lease, taken_at)]

    def _after(self, lease: Lease, taken_at: float) -> bool:
        return max(lease.granted_at, lease.ready_at, self.enlarged.get(lease.id, 0.0)) > taken_at

    def filling(self, since: float) -> Iterator[Lease]:
        """Yield leases that load, or became ready after `since`.

        HELD lists them in the order of `ready_at`.
        """
        for lease in reversed(self._by_state[LeaseState.HELD].values()):
            if lease.ready_at <= since:
                break
            yield lease
        yield from self._by_state[LeaseState.LOADING].values()
        for lease in self.in_state(LeaseState.REVOKING, LeaseState.UNLOADING, LeaseState.VERIFYING):
            if lease.ready_at > since:
                yield lease

    def ready_since(self, moment: float) -> Iterator[Lease]:
        """Yield leases that became ready at `moment` or later and do not unload yet."""
        for lease in reversed(self._by_state[LeaseState.HELD].values()):
            if lease.ready_at < moment:
                break
            yield lease
        for lease in self._by_state[LeaseState.REVOKING].values():
            if lease.ready_at >= moment:
                yield lease

    def disagreement(self) -> str:
        """Return where tables and leases disagree, "" if nowhere. O(leases): for tests."""
        for state, table in self._by_state.items():
            if table.keys() != {lease.id for lease in self.values() if lease.state is state}:
                return f"{sorted(table)} are listed as {state}"
        if self.exclusive.keys() != {lease.id for lease in self.values() if lease.spec.exclusive}:
            return f"{sorted(self.exclusive)} are listed as exclusive"
        if self.pinned.keys() != {lease.id for lease in self.values() if not lease.evictable}:
            return f"{sorted(self.pinned)} are listed as pinned"
        return ""
