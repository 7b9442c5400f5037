"""What must always be true, checked after every event, also in production. A violation stops the daemon: it is not handled.

Numbers are those of the design:
  1. approved bytes never exceed capacity − reserve, and a grant fits together with stowaways at its moment
  2. nobody is resident beside an exclusive lease
  3. nothing that is in use unloads
  4. bytes stay charged until a verdict: whoever is resident is charged, whoever is charged is resident or under measurement
  5. tokens only grow
  6. every waiter is in a queue, has a timer if it has a bound, and its card has a next reading scheduled
"""

from arbiter.core.lease import LeaseState
from arbiter.core.state import Core, Gpu


class InvariantViolation(Exception):
    """A defect of the engine. `number` is the invariant's."""

    def __init__(self, number: int, message: str) -> None:
        super().__init__(f"invariant {number}: {message}")
        self.number = number


def check(core: Core) -> None:
    """Raise InvariantViolation unless everything holds."""
    for gpu in core.gpus.values():
        _bytes(core, gpu)
        _residents(core, gpu)
        _charges(gpu)
    _tokens(core)
    _waiters(core)


def _bytes(core: Core, gpu: Gpu) -> None:
    approved = gpu.ledger.approved_bytes()
    if approved > gpu.ledger.budget_bytes:
        raise InvariantViolation(
            1, f"{approved} bytes approved on {gpu.info.id}, budget {gpu.ledger.budget_bytes}"
        )
    if _granted_on(core, gpu) and gpu.ledger.total_bytes() > gpu.ledger.budget_bytes:
        raise InvariantViolation(
            1, f"granted on {gpu.info.id}, which now has {gpu.ledger.total_bytes()} bytes to bear"
        )


def _granted_on(core: Core, gpu: Gpu) -> bool:
    """Did this very event grant something here? What was found after a restart may be crowded without our doing."""
    return any(gpu_id == gpu.info.id for _, gpu_id in core.granted)


def _residents(core: Core, gpu: Gpu) -> None:
    if _granted_on(core, gpu):
        exclusive = [lease.id for lease in gpu.residents.values() if lease.spec.exclusive]
        if exclusive and len(gpu.residents) > 1:
            raise InvariantViolation(
                2, f"{exclusive[0]} is exclusive, yet {sorted(gpu.residents)} are on {gpu.info.id}"
            )
        loading = [lease.id for lease in gpu.in_state(LeaseState.LOADING)]
        if len(loading) > 1:
            raise InvariantViolation(2, f"{loading} load at once on {gpu.info.id}")
    for lease in gpu.residents.values():
        if lease.uses and lease.state not in (LeaseState.HELD, LeaseState.REVOKING):
            raise InvariantViolation(3, f"{lease.id} is {lease.state} with {len(lease.uses)} uses")


def _charges(gpu: Gpu) -> None:
    charged = set(gpu.ledger.leases())
    for lease in gpu.residents.values():
        if lease.id not in charged:
            raise InvariantViolation(4, f"{lease.id} is {lease.state} and not charged")
        if lease.state is LeaseState.VERIFYING and lease.id not in gpu.verifications:
            raise InvariantViolation(4, f"{lease.id} waits for a verdict that nobody works on")
    for lease_id in charged - gpu.residents.keys():
        if lease_id not in gpu.verifications:
            raise InvariantViolation(4, f"the bytes of {lease_id} are charged for ever")


def _tokens(core: Core) -> None:
    for token, _ in core.granted:
        if token <= core.last_token:
            raise InvariantViolation(5, f"token {token} after {core.last_token}")
        core.last_token = token


def _waiters(core: Core) -> None:
    queued = sum(len(gpu.queue) for gpu in core.gpus.values())
    if queued < len(core.waiting) or (len(core.gpus) == 1 and queued != len(core.waiting)):
        raise InvariantViolation(6, f"{len(core.waiting)} leases wait, {queued} are in queues")
    for gpu in core.gpus.values():
        head = gpu.queue.head()
        if head is None:
            continue
        if head.id not in core.waiting:
            raise InvariantViolation(6, f"{head.id} is {head.state}, yet it is the head of {gpu.info.id}")
        if head.wait_timeout_s is not None and ("wait", head.id) not in core.timers:
            raise InvariantViolation(6, f"{head.id} has a bound and no timer")
        if ("probe", gpu.info.id) not in core.timers:
            raise InvariantViolation(6, f"nobody will read {gpu.info.id} again, and {head.id} waits")
