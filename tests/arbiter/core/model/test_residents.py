"""The sub-tables of a GPU's residents follow every change; the full invariant check compares them
with the leases."""

from tests.support.core_driver import CoreDriver
from vram_arbiter.arbiter.core.model.gpu import Residents
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import GpuId


def crowd(count: int) -> tuple[Residents, list[Lease]]:
    """A GPU of small held leases of one process."""
    driver = CoreDriver(8 * d.GIB)
    holder = driver.consumer("a")
    ids = []
    for _ in range(count):
        ids.append(holder.acquire(d.MIB))
        holder.load(ids[-1])
    core = driver.arbiter.inspect()
    return core.gpus[GpuId("GPU-0")].residents, [core.leases[lease_id] for lease_id in ids]


def test_a_reading_sees_what_happened_before_it_began() -> None:
    residents, (one, two) = crowd(2)
    one.granted_at = one.ready_at = 5.0
    assert {lease.id for lease in residents.unseen(4.0)} == {one.id, two.id}
    assert residents.unseen(5.0) == [two]
    residents.seen(5.0)
    assert list(residents.recent) == [two.id]


def test_who_fills_the_gpu_since_a_moment() -> None:
    """Loads now, or became ready later, whatever it does since; whoever was ready before is not
    even looked at."""
    residents, (one, two, three, four) = crowd(4)
    for at, lease in enumerate((one, two, three, four)):
        lease.ready_at = float(at)
    at = 1
    for lease in (three, one):
        lease.move(LeaseState.REVOKING, at + 9.0, "asked")
        residents.moved(lease, LeaseState.HELD)
    assert [lease.id for lease in residents.filling(at)] == [four.id, three.id]
    assert list(residents.filling(four.ready_at)) == []
    assert {lease.id for lease in residents.filling(-1.0)} == {one.id, two.id, three.id, four.id}
    four.state = LeaseState.LOADING
    residents.moved(four, LeaseState.HELD)
    assert list(residents.filling(four.ready_at)) == [four]


def test_who_was_ready_at_the_very_moment_has_loaded_since_it() -> None:
    residents, (one, two, three) = crowd(3)
    for at, lease in enumerate((one, two, three)):
        lease.granted_at = lease.ready_at = float(at)
    assert list(residents.loaded_since(two.ready_at)) == [three, two]
    two.move(LeaseState.REVOKING, 9.0, "asked")
    residents.moved(two, LeaseState.HELD)
    assert list(residents.loaded_since(two.ready_at)) == [three, two]
