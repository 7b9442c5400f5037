"""Policies by name: each changes who is next or who leaves, and nothing else."""

from typing import get_args

import pytest

from tests.support.core_driver import CoreDriver
from vram_arbiter.arbiter.core.settings import SCHEDULING
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.config.arbiter import SchedulingConfig
from vram_arbiter.schemas.ids import LeaseId

GIB = d.GIB


class Room:
    """8 GiB to lease out under one policy; holders load at once, and leave when they are asked
    while idle."""

    def __init__(self, policy: str) -> None:
        self.driver = CoreDriver(8 * GIB + d.RESERVE_BYTES, settings={"policy": policy})

    def hold(self, name: str, gib: float, **spec: int) -> LeaseId:
        person = self.driver.consumer(name)
        lease = person.acquire(int(gib * GIB), **spec)
        self.driver.until(lambda: self.driver.state(lease) == "loading")
        person.load(lease)
        self.driver.advance(0.01)
        return lease

    def wait(self, name: str, gib: float, **spec: int) -> LeaseId:
        lease = self.driver.consumer(name).acquire(int(gib * GIB), **spec)
        self.driver.advance(0.1)
        return lease

    def state(self, lease: LeaseId) -> str:
        return self.driver.state(lease)

    def asked(self) -> list[str]:
        return [str(push["lease_id"]) for push in self.driver.pushes("revoke")]


def test_the_configuration_offers_exactly_the_policies_of_the_core() -> None:
    names = get_args(SchedulingConfig.model_fields["policy"].annotation)
    assert names == tuple(SCHEDULING)
    assert SchedulingConfig().policy == CoreDriver().settings.policy


def test_an_unknown_policy_stops_the_start() -> None:
    with pytest.raises(KeyError):
        CoreDriver(settings={"policy": "best"})


@pytest.mark.parametrize(("policy", "first"), [("default", "urgent"), ("fifo", "early")])
def test_fifo_goes_by_arrival_and_default_by_priority(policy: str, first: str) -> None:
    room = Room(policy)
    holder = room.driver.consumer("holder")
    held = holder.acquire(8 * GIB)
    holder.load(held)
    holder.use_begin(held)
    room.driver.advance(0.01)
    waiters = {
        "early": room.wait("early", 8, priority=10),
        "urgent": room.wait("urgent", 8, priority=90),
    }
    holder.use_end(held)
    holder.unload(held)
    room.driver.until(lambda: any(room.state(lease) == "loading" for lease in waiters.values()))
    assert [name for name, lease in waiters.items() if room.state(lease) == "loading"] == [first]


@pytest.mark.parametrize(
    ("policy", "state"), [("default", "loading"), ("no_backfill", "queued"), ("fifo", "queued")]
)
def test_a_small_waiter_passes_only_where_backfill_is(policy: str, state: str) -> None:
    room = Room(policy)
    holder = room.driver.consumer("holder")
    held = holder.acquire(4 * GIB)
    holder.load(held)
    holder.use_begin(held)
    room.driver.advance(0.01)
    head = room.wait("head", 6, priority=90)
    small = room.wait("small", 1, priority=10)
    room.driver.advance(1.0)
    assert (room.state(head), room.state(small)) == ("queued", state)


@pytest.mark.parametrize(("policy", "asked"), [("default", ["big"]), ("lru", ["old", "big"])])
def test_lru_asks_the_oldest_even_where_one_other_would_do(policy: str, asked: list[str]) -> None:
    room = Room(policy)
    names = {room.hold("old", 2): "old", room.hold("big", 4): "big", room.hold("young", 2): "young"}
    room.wait("wants", 4)
    assert [names[LeaseId(lease)] for lease in room.asked()] == asked


def test_lru_leaves_holders_in_use_for_last() -> None:
    room = Room("lru")
    worker = room.driver.consumer("worker")
    busy = worker.acquire(4 * GIB)
    worker.load(busy)
    room.driver.advance(0.01)
    worker.use_begin(busy)
    idle = room.hold("idle", 4)
    room.wait("wants", 4)
    assert room.asked() == [idle]


@pytest.mark.parametrize(("policy", "asked"), [("default", 0), ("one_model", 1)])
def test_one_model_empties_the_gpu_even_where_both_fit(policy: str, asked: int) -> None:
    room = Room(policy)
    room.hold("first", 2)
    second = room.wait("second", 2)
    assert len(room.asked()) == asked
    assert (room.state(second) == "loading") == (asked == 0)
