"""Each invariant, broken by hand, is found by its number. A sound state is never complained about
(the other tests)."""

from collections.abc import Callable
from dataclasses import replace

import pytest

from tests.support import full_check
from tests.support.core_driver import CoreDriver
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core import invariants
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.arbiter.core.invariants import InvariantViolation
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Use
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, Token, UseId

X = ProcessKey(5, 5)


class Broken:
    """One held lease, one queued lease (with a bound), and free access to the inside."""

    def __init__(self) -> None:
        self.driver = CoreDriver(8 * GIB)
        holder = self.driver.consumer("a")
        held = holder.acquire(5 * GIB, priority=90)
        holder.load(held)
        holder.hold(GIB)  # it has room to lend
        holder.use_begin(held)
        self.driver.advance(1.5)
        self.driver.consumer("b").acquire(5 * GIB, wait_timeout_s=50.0)
        self.core: Core = state_of(self.driver.arbiter)
        self.gpu: Gpu = self.core.gpus[GpuId("GPU-0")]
        self.held: Lease = self.core.leases[held]
        self.queued: Lease = next(iter(self.core.waiting.values()))
        self.core.turn.granted.clear()
        invariants.check(self.core)


def force(b: Broken, lease: Lease, state: LeaseState) -> None:
    """Go where the table of transitions does not lead."""
    before, lease.state = lease.state, state
    b.gpu.residents.moved(lease, before)


def idle(b: Broken) -> None:
    for use in list(b.held.uses.values()):
        b.core.unmark(b.held, use)


def over_budget(b: Broken) -> None:
    b.gpu.ledger.charge(LeaseId("x"), X, 5 * GIB, 5 * GIB, 0.0)


def granted_under_pressure(b: Broken) -> None:
    b.core.turn.granted.append((Token(1, 99), b.gpu.info.id))
    b.gpu.ledger.unattributed_bytes = b.gpu.ledger.stowaway_bytes = 4 * GIB


def beside_exclusive(b: Broken) -> None:
    b.held.spec = replace(b.held.spec, mode="exclusive")
    b.gpu.residents.add(b.held)
    b.gpu.ledger.charge(b.queued.id, X, 1, 1, 0.0)
    b.gpu.residents.add(b.queued)
    b.core.turn.granted.append((Token(1, 99), b.gpu.info.id))


def beside_exclusive_debt(b: Broken) -> None:
    b.driver.device.silent = True
    b.held.spec = replace(b.held.spec, mode="exclusive")
    b.driver.post(ProcessDied(b.held.process))
    b.core.turn.granted.append((Token(1, 99), b.gpu.info.id))


def two_loads(b: Broken) -> None:
    idle(b)
    force(b, b.held, LeaseState.LOADING)
    b.queued.state = LeaseState.LOADING
    b.gpu.ledger.charge(b.queued.id, X, 1, 1, 0.0)
    b.gpu.residents.add(b.queued)
    b.core.turn.granted.append((Token(1, 99), b.gpu.info.id))


def unloads_in_use(b: Broken) -> None:
    b.core.mark(b.held, Use(UseId("u"), ClientId("c"), X, "", 0.0))
    force(b, b.held, LeaseState.UNLOADING)


def resident_without_charge(b: Broken) -> None:
    b.gpu.ledger.drop(b.held.id, 0, 0, 0.0)


def verifying_without_verification(b: Broken) -> None:
    idle(b)
    force(b, b.held, LeaseState.VERIFYING)


def charged_for_ever(b: Broken) -> None:
    b.gpu.ledger.charge(LeaseId("x"), X, 1, 1, 0.0)


def revoked_for_nothing(b: Broken) -> None:
    force(b, b.held, LeaseState.REVOKING)


def token_shrinks(b: Broken) -> None:
    b.core.turn.granted.append((Token(1, 1), GpuId("GPU-1")))


def waiter_in_no_queue(b: Broken) -> None:
    b.gpu.queue.discard(b.queued)


def queue_without_waiter(b: Broken) -> None:
    del b.core.waiting[b.queued.id]
    b.core.waiting[LeaseId("other")] = b.queued


def bound_without_timer(b: Broken) -> None:
    b.core.timers.cancel(("wait", b.queued.id))


def no_next_reading(b: Broken) -> None:
    b.core.timers.cancel(("probe", b.gpu.info.id))


def parked_beyond_the_budget(b: Broken) -> None:
    b.core.host_ram.booked[b.held.id] = b.core.host_ram.budget_bytes + 1


def away_with_a_gpu(b: Broken) -> None:
    idle(b)
    force(b, b.held, LeaseState.PARKED)
    b.core.away[b.held.id] = b.held


def away_and_held(b: Broken) -> None:
    b.core.away[b.held.id] = b.held


@pytest.mark.parametrize(
    ("number", "breaks", "says"),
    [
        (1, over_budget, "10737418240 bytes approved on GPU-0, budget 8275361792"),
        (1, granted_under_pressure, "granted on GPU-0, which now has 9663676416 bytes to bear"),
        (2, beside_exclusive, "L1-1 is exclusive, yet ['L1-1', 'L1-3'] are on GPU-0"),
        (
            2,
            beside_exclusive_debt,
            "L1-1 was exclusive on GPU-0 and is not measured gone, yet a lease came",
        ),
        (2, two_loads, "['L1-1', 'L1-3'] load at once on GPU-0"),
        (3, unloads_in_use, "L1-1 is unloading with 2 uses"),
        (4, resident_without_charge, "L1-1 is held and not charged"),
        (
            4,
            verifying_without_verification,
            "L1-1 waits for a verdict, but no verification is under way",
        ),
        (4, charged_for_ever, "the bytes of x are charged for ever"),
        (5, token_shrinks, "token 1.1 after 1.2"),
        (6, waiter_in_no_queue, "1 leases wait, 0 are in queues"),
        (6, queue_without_waiter, "L1-3 is queued, yet it is the head of GPU-0"),
        (6, bound_without_timer, "L1-3 has a bound and no timer"),
        (4, parked_beyond_the_budget, "1 bytes are parked, budget 0"),
        (4, away_with_a_gpu, "L1-1 is parked, yet it has a GPU or waits for one"),
        (4, away_and_held, "L1-1 is held, yet it counts as away"),
        (6, no_next_reading, "no reading of GPU-0 is planned, and L1-3 waits"),
        (7, revoked_for_nothing, "L1-1 is revoked, and nothing wants its bytes"),
    ],
)
@pytest.mark.parametrize("check", [invariants.check, full_check.check_all])
def test_a_broken_state_is_found(
    check: Callable[[Core], None], number: int, breaks: Callable[[Broken], None], says: str
) -> None:
    broken = Broken()
    breaks(broken)
    broken.gpu.touched = True
    with pytest.raises(InvariantViolation) as caught:
        check(broken.core)
    assert (caught.value.number, str(caught.value)) == (number, f"invariant {number}: {says}")


def sum_off(b: Broken) -> None:
    b.gpu.ledger._held_bytes += 1


def account_off(b: Broken) -> None:
    charges = b.gpu.ledger.accounts[b.held.process].charges
    charges[b.held.id] = replace(charges[b.held.id], charged_bytes=0)


def approved_off(b: Broken) -> None:
    account = b.gpu.ledger.accounts[b.held.process]
    charge = account.charges[b.held.id]
    account.charges[b.held.id] = replace(charge, approved_bytes=charge.approved_bytes + 1)
    account.leased_approved_bytes += 1


def state_off(b: Broken) -> None:
    b.held.state = LeaseState.REVOKING


def exclusive_off(b: Broken) -> None:
    b.gpu.residents.exclusive.add(b.held.id)


def client_off(b: Broken) -> None:
    b.held.client = ClientId("somebody")


def gone_and_listed(b: Broken) -> None:
    del b.core.leases[b.held.id]


def connected_off(b: Broken) -> None:
    del b.core.connected[b.held.process]


def user_off(b: Broken) -> None:
    b.core.users[X] = b.core.users.pop(b.held.process)


def waiters_off(b: Broken) -> None:
    b.core.waiting.of[b.held.process] = 1


@pytest.mark.parametrize(
    ("breaks", "says"),
    [
        (waiters_off, "waiters are"),
        (user_off, "uses are listed otherwise than they are"),
        (client_off, "not listed under its process and its client"),
        (gone_and_listed, "listed and gone"),
        (connected_off, "are connected, kept as"),
        (sum_off, "the sums are"),
        (account_off, "is charged"),
        (approved_off, "and approved"),
        (state_off, "states are listed otherwise"),
        (exclusive_off, "listed as exclusive"),
    ],
)
def test_a_table_that_lies_is_found(breaks: Callable[[Broken], None], says: str) -> None:
    """The check of each event stands on tables; the full one counts for itself."""
    broken = Broken()
    breaks(broken)
    invariants.check(broken.core)
    with pytest.raises(InvariantViolation, match=f"invariant 0: .*{says}"):
        full_check.check_all(broken.core)


def test_a_charge_lost_long_ago_is_found_by_the_full_check_alone() -> None:
    """`check` looks at who was touched; nobody else can have changed, unless somebody went around
    the ledger's methods."""
    broken = Broken()
    del broken.gpu.ledger.charges[broken.held.id]
    invariants.check(broken.core)
    with pytest.raises(InvariantViolation, match="the charges are"):
        full_check.check_all(broken.core)


def test_a_violation_stops_the_event() -> None:
    broken = Broken()
    over_budget(broken)
    with pytest.raises(InvariantViolation):
        broken.driver.consumer("c")
