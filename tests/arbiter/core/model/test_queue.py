"""Order of waiters: priority, arrival, and ageing that never reorders equals."""

from vram_arbiter.arbiter.core.model.gpu import WaitQueue
from vram_arbiter.arbiter.core.model.lease import Lease, Request
from vram_arbiter.schemas.ids import ClientId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


def waiter(arrival: int, at: float, priority: int = 50, need: int = 10) -> Lease:
    spec = LeaseSpec(
        consumer="c",
        model_id="m",
        footprint=Footprint(need, need, 0),
        priority=priority,
        min_residency_s=0.0,
    )
    return Lease(
        LeaseId(f"L1-{arrival}"),
        spec,
        ProcessKey(1, 1),
        ClientId("c"),
        Request("n", at, arrival, need, need),
    )


def arrivals(queue: WaitQueue) -> list[int]:
    return [lease.request.arrival for lease in queue]


def test_priority_then_arrival() -> None:
    queue = WaitQueue(5.0)
    for lease in (
        waiter(1, 0.0),
        waiter(2, 0.0),
        waiter(3, 0.1, priority=60),
        waiter(4, 0.2, priority=40),
    ):
        queue.add(lease)
    assert arrivals(queue) == [3, 1, 2, 4]


def test_ageing_bounds_the_wait_behind_higher_priorities() -> None:
    queue = WaitQueue(5.0)
    queue.add(old := waiter(1, 0.0, priority=50))
    queue.add(waiter(2, 40.0, priority=60))
    assert arrivals(queue) == [2, 1], "ten points are worth 50 s"
    queue.add(waiter(3, 60.0, priority=60))
    assert arrivals(queue) == [2, 1, 3]
    assert queue.position(old) == 2
    assert queue.ahead_of(old) is queue.by_arrival[2]
    head = queue.head
    assert head is not None
    assert queue.ahead_of(head) is None


def test_taking_out_and_the_smallest_need() -> None:
    queue = WaitQueue(5.0)
    assert queue.head is None
    a, b = waiter(1, 0.0, need=30), waiter(2, 0.0, need=20)
    queue.add(a)
    queue.add(b)
    assert (len(list(queue)), queue.smallest_need_bytes()) == (2, 20)
    assert b in queue
    queue.discard(b)
    queue.discard(b)
    assert b not in queue
    assert (len(list(queue)), queue.smallest_need_bytes()) == (1, 30)
