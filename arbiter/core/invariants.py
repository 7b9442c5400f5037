"""Invariants of the engine, checked after every event, also in production. A violation stops the
daemon.

`check` looks at the GPUs that the event touched and, there, at what changed, so its cost does not
grow with the number of leases. `check_all` looks at everything, also at the tables that `check`
relies on. The drivers of the tests and the simulation run it after every event.

Public: `check`, `check_all`, `InvariantViolation`. By number:
  1. approved bytes never exceed capacity − reserve; a grant fits beside stowaways at its moment
  2. an exclusive lease has no other resident beside it, none is granted before its bytes are
     measured
     gone; one lease at a time loads on a GPU
  3. a lease in use is not unloaded
  4. bytes stay charged until a verdict: a resident is charged, a charged lease is resident, under
     measurement or reserved; a lease on standby is neither; parked weights fit the host RAM budget
  5. tokens only grow
  6. every waiter is in a queue, a bounded one has a timer, and its GPU has a next reading planned
  7. of a gang that is not complete, all waiting members are charged, or none
"""

from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import NOT_COUNTED, Core, Gpu
from vram_arbiter.arbiter.core.model.turn import Turn

_UNUSED = tuple(
    state for state in LeaseState if state not in (LeaseState.HELD, LeaseState.REVOKING)
)
"""States in which a lease has no uses."""
_UNUSED_HERE = (LeaseState.LOADING, LeaseState.UNLOADING, LeaseState.VERIFYING)
"""Those that a resident can be in."""


class InvariantViolation(Exception):
    """A defect of the engine. `number` is the invariant's."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(f"invariant {number}: {message}")
        self.number = number


def check(core: Core) -> None:
    """Raise InvariantViolation if the event of this turn broke something."""
    granted_on = {gpu_id for _, gpu_id in core.turn.granted}
    for gpu in core.turn.touched.values():
        granted = gpu.info.id in granted_on
        _bytes(gpu, granted=granted)
        _residents(gpu, granted=granted)
        _charges(gpu)
        _head(core, gpu)
    _tokens(core)
    _waiters(core)
    for feature in core.hooked["check"]:
        feature.check(core, everything=False)


def check_all(core: Core) -> None:
    """Check every GPU and lease, and the tables that `check` relies on. O(leases): for tests."""
    if problem := core.disagreement():
        raise InvariantViolation(0, problem)
    for gpu in core.gpus.values():
        problem = gpu.ledger.disagreement() or gpu.residents.disagreement()
        if problem:
            raise InvariantViolation(0, f"{gpu.info.id}: {problem}")
        gpu.ledger.touched.update(gpu.ledger.leases(), gpu.residents, gpu.debts)
        for lease in gpu.residents.values():
            _unused(lease)
    core.counted = NOT_COUNTED
    turn = core.turn
    core.turn = Turn(
        granted=turn.granted, touched={gpu.info.index: gpu for gpu in core.gpus.values()}
    )
    check(core)
    core.turn = turn
    for feature in core.hooked["check"]:
        feature.check(core, everything=True)


def _bytes(gpu: Gpu, *, granted: bool) -> None:
    approved = gpu.ledger.approved_bytes()
    if approved > gpu.ledger.budget_bytes:
        raise InvariantViolation(
            1, f"{approved} bytes approved on {gpu.info.id}, budget {gpu.ledger.budget_bytes}"
        )
    if granted and gpu.ledger.total_bytes() > gpu.ledger.budget_bytes:
        raise InvariantViolation(
            1, f"granted on {gpu.info.id}, which now has {gpu.ledger.total_bytes()} bytes to bear"
        )


def _residents(gpu: Gpu, *, granted: bool) -> None:
    residents = gpu.residents
    if granted:
        alone = next(iter(residents.exclusive.values()), None)
        if alone is not None and any(lease is not alone for lease in residents.values()):
            raise InvariantViolation(
                2, f"{alone.id} is exclusive, yet {sorted(residents)} are on {gpu.info.id}"
            )
        debts = [
            v.lease for v in gpu.verifications.values() if v.exclusive and v.lease not in residents
        ]
        if debts:
            raise InvariantViolation(
                2,
                f"{debts[0]} was exclusive on {gpu.info.id} and is not measured gone, yet a lease "
                "came",
            )
        loading = [lease.id for lease in residents.in_state(LeaseState.LOADING)]
        if len(loading) > 1:
            raise InvariantViolation(2, f"{loading} load at once on {gpu.info.id}")
    for lease in residents.in_state(*_UNUSED_HERE):
        _unused(lease)


def _unused(lease: Lease) -> None:
    if (lease.uses or lease.uses.paused) and lease.state in _UNUSED:
        raise InvariantViolation(
            3, f"{lease.id} is {lease.state} with {len(lease.all_uses())} uses"
        )


def _charges(gpu: Gpu) -> None:
    """Only leases that came, went, were charged or dropped since the last check are examined."""
    ledger, residents = gpu.ledger, gpu.residents
    if ledger.touched or residents.touched:
        touched = ledger.touched | residents.touched
        for lease_id in sorted(touched):
            if lease_id in residents and not ledger.charges(lease_id):
                raise InvariantViolation(
                    4, f"{lease_id} is {residents[lease_id].state} and not charged"
                )
        gpu.debts |= touched
        ledger.touched.clear()
        residents.touched.clear()
    for lease_id in [
        lease_id for lease_id in gpu.debts if lease_id in residents or not ledger.charges(lease_id)
    ]:
        gpu.debts.discard(lease_id)
    for lease_id in sorted(gpu.debts) if gpu.debts else ():
        if lease_id not in gpu.verifications and lease_id not in gpu.ledger.reserved:
            raise InvariantViolation(4, f"the bytes of {lease_id} are charged for ever")
    for lease in residents.in_state(LeaseState.VERIFYING):
        if lease.id not in gpu.verifications:
            raise InvariantViolation(
                4, f"{lease.id} waits for a verdict, but no verification is under way"
            )


def _tokens(core: Core) -> None:
    for token, _ in core.turn.granted:
        if token <= core.last_token:
            raise InvariantViolation(5, f"token {token} after {core.last_token}")
        core.last_token = token
    core.turn.granted.clear()


def _counts(core: Core, queued: int) -> None:
    """Counted only when a number has changed: a feature may keep thousands of requests out of the
    queues.
    """
    unqueued = (lease for feature in core.hooked["unplaced"] for lease in feature.unplaced())
    waiting = len(core.waiting) - sum(lease.state is LeaseState.QUEUED for lease in unqueued)
    if queued < waiting or (len(core.gpus) == 1 and queued != waiting):
        raise InvariantViolation(6, f"{waiting} leases wait, {queued} are in queues")
    core.counted = (queued, len(core.waiting))


def _waiters(core: Core) -> None:
    if not core.turn.touched:
        return
    queued = sum(len(gpu.queue) for gpu in core.gpus.values())
    if (queued, len(core.waiting)) != core.counted:
        _counts(core, queued)


def _head(core: Core, gpu: Gpu) -> None:
    head = gpu.queue.head()
    if head is None:
        return
    if head.id not in core.waiting:
        raise InvariantViolation(
            6, f"{head.id} is {head.state}, yet it is the head of {gpu.info.id}"
        )
    if head.request.extends is not None and head.request.extends not in gpu.residents:
        raise InvariantViolation(
            6, f"{head.id} waits to extend {head.request.extends}, which is not there"
        )
    if head.request.wait_timeout_s is not None and ("wait", head.id) not in core.timers:
        raise InvariantViolation(6, f"{head.id} has a bound and no timer")
    if ("probe", gpu.info.id) not in core.timers:
        raise InvariantViolation(6, f"no reading of {gpu.info.id} is planned, and {head.id} waits")
