"""Invariants of the engine, checked after every event, also in production. A violation stops the
daemon.

`check` looks at the GPUs that the event touched and, there, at what changed, so its cost does not
grow with the number of leases. The tests' drivers also check everything
(`tests.support.full_check`). By number:
  1. approved bytes never exceed capacity − reserve; a grant fits beside stowaways at its moment
  2. an exclusive lease has no other resident beside it, none is granted before its bytes are
     measured gone; one lease at a time loads on a GPU
  3. a lease in use is not unloaded
  4. bytes stay charged until a verdict: a resident is charged, a charged lease is resident, under
     measurement; a lease that is away is neither; parked weights fit the host RAM budget
  5. tokens only grow
  6. every waiter is in a queue, a bounded one has a timer, and its GPU has a next reading planned
  7. a holder is revoked for someone: a waiter, pressure or an operator
"""

from collections.abc import Container

from vram_arbiter.arbiter.core.eviction import is_wanted
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Timers
from vram_arbiter.schemas.ids import LeaseId

_UNUSED = (LeaseState.LOADING, LeaseState.UNLOADING, LeaseState.VERIFYING)
"""States of a resident without uses."""


class InvariantViolation(Exception):
    """A defect of the engine. `number` is the invariant's."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(f"invariant {number}: {message}")
        self.number = number


def check(core: Core) -> None:
    """Raise InvariantViolation if the event of this turn broke something."""
    granted_on = {gpu_id for _, gpu_id in core.turn.granted}
    for gpu in [gpu for gpu in core.gpus.values() if gpu.touched]:
        if gpu.info.id in granted_on:
            _check_grant(gpu)
        _check_gpu(gpu)
        if (head := gpu.queue.head) is not None:
            _check_head(gpu, head, core.waiting, core.timers)
        for lease in gpu.residents.by_state[LeaseState.REVOKING].values():
            asked = lease.departure.eviction
            if asked is None or not is_wanted(core.waiting, gpu, asked):
                raise InvariantViolation(7, f"{lease.id} is revoked, and nothing wants its bytes")
    for token, _ in core.turn.granted:
        if token <= core.last_token:
            raise InvariantViolation(5, f"token {token} after {core.last_token}")
        core.last_token = token
    queued = sum([len(gpu.queue.by_arrival) for gpu in core.gpus.values()])
    waiting = len(core.waiting)
    if queued < waiting or (len(core.gpus) == 1 and queued != waiting):
        raise InvariantViolation(6, f"{waiting} leases wait, {queued} are in queues")
    if (fitted := core.host_ram.fitted_bytes()) > core.host_ram.budget_bytes:
        raise InvariantViolation(
            4, f"{fitted} bytes are parked, budget {core.host_ram.budget_bytes}"
        )
    for lease in core.away.values():
        if lease.state not in AWAY or lease.id not in core.leases:
            raise InvariantViolation(4, f"{lease.id} is {lease.state}, yet it counts as away")
        if lease.gpu is not None or lease.id in core.waiting:
            told = f"{lease.id} is {lease.state}, yet it has a GPU or waits for one"
            raise InvariantViolation(4, told)


def _check_grant(gpu: Gpu) -> None:
    """A lease was granted on a GPU."""
    ledger, residents = gpu.ledger, gpu.residents
    if ledger.total_bytes() > ledger.budget_bytes:
        raise InvariantViolation(
            1, f"granted on {gpu.info.id}, which now has {ledger.total_bytes()} bytes to bear"
        )
    if residents.exclusive and len(residents) > 1:
        alone = next(iter(residents.exclusive))
        raise InvariantViolation(
            2, f"{alone} is exclusive, yet {sorted(residents)} are on {gpu.info.id}"
        )
    for verification in gpu.verifications.values():
        if verification.exclusive and verification.lease not in residents:
            raise InvariantViolation(
                2,
                f"{verification.lease} was exclusive on {gpu.info.id} and is not measured gone, "
                "yet a lease came",
            )
    loading = list(residents.by_state[LeaseState.LOADING])
    if len(loading) > 1:
        raise InvariantViolation(2, f"{loading} load at once on {gpu.info.id}")


def _check_gpu(gpu: Gpu) -> None:
    """Examine the residents that cannot be in use, the leases that came, went, were charged or
    dropped since the last check, and those that are charged and not resident."""
    ledger, residents = gpu.ledger, gpu.residents
    approved = ledger.approved_bytes
    if approved > ledger.budget_bytes:
        raise InvariantViolation(
            1, f"{approved} bytes approved on {gpu.info.id}, budget {ledger.budget_bytes}"
        )
    for lease in [lease for state in _UNUSED for lease in residents.by_state[state].values()]:
        if uses := len(lease.uses):
            raise InvariantViolation(3, f"{lease.id} is {lease.state} with {uses} uses")
        if lease.state is LeaseState.VERIFYING and lease.id not in gpu.verifications:
            raise InvariantViolation(
                4, f"{lease.id} waits for a verdict, but no verification is under way"
            )
    gpu.debts |= ledger.touched | residents.touched
    ledger.touched.clear()
    residents.touched.clear()
    for lease_id in sorted(gpu.debts):
        charged = lease_id in ledger.charges
        if lease_id in residents and not charged:
            state = residents[lease_id].state
            raise InvariantViolation(4, f"{lease_id} is {state} and not charged")
        if lease_id in residents or not charged:
            gpu.debts.discard(lease_id)
        elif lease_id not in gpu.verifications:
            raise InvariantViolation(4, f"the bytes of {lease_id} are charged for ever")


def _check_head(gpu: Gpu, head: Lease, waiting: Container[LeaseId], timers: Timers) -> None:
    if head.id not in waiting:
        raise InvariantViolation(
            6, f"{head.id} is {head.state}, yet it is the head of {gpu.info.id}"
        )
    if head.request.wait_timeout_s is not None and ("wait", head.id) not in timers:
        raise InvariantViolation(6, f"{head.id} has a bound and no timer")
    if ("probe", gpu.info.id) not in timers:
        raise InvariantViolation(6, f"no reading of {gpu.info.id} is planned, and {head.id} waits")
