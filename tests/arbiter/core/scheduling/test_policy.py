"""Who leaves: the cheapest set that covers the need, nobody in vain."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, Verification
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Block, Order


class Scene:
    """A GPU with holders; `want` says who is asked when somebody wants room."""

    def __init__(self, capacity_bytes: int = 8 * GIB + d.RESERVE_BYTES, **settings: Any) -> None:
        self.driver = CoreDriver(capacity_bytes, settings=settings)
        self.names: dict[LeaseId, str] = {}
        self.people: dict[str, Consumer] = {}
        self.held: dict[str, LeaseId] = {}

    def hold(self, name: str, gib: float, **spec: Any) -> LeaseId:
        person = self.people[name] = self.driver.consumer(name)
        lease = person.acquire(int(gib * GIB), **spec)
        self.driver.until(lambda: self.driver.state(lease) == "loading")
        person.load(lease)
        self.driver.advance(0.01)
        self.names[lease] = name
        self.held[name] = lease
        return lease

    def use(self, name: str) -> None:
        self.people[name].use_begin(self.held[name])

    def want(self, gib: float, **spec: Any) -> set[str]:
        self.people["w"] = self.driver.consumer("w")
        self.held["w"] = self.people["w"].acquire(int(gib * GIB), **spec)
        return self.asked()

    def asked(self) -> set[str]:
        return {self.names[LeaseId(push["lease_id"])] for push in self.driver.pushes("revoke")}

    @property
    def gpu(self) -> Gpu:
        return next(iter(state_of(self.driver.arbiter).gpus.values()))


def has(name: str, gib: float, *, used: bool = False, **spec: Any) -> dict[str, Any]:
    return {"name": name, "gib": gib, "used": used, **spec}


WEAKER = [has("low", 1, priority=10), has("mid", 2, priority=20), has("high", 4, priority=30)]
VICTIMS: dict[str, tuple[list[dict[str, Any]], dict[str, Any], set[str]]] = {
    "it fits": ([has("a", 3)], {"gib": 5}, set()),
    "one that covers is better than two": (
        [has("small", 1), has("medium", 2), has("large", 4)], {"gib": 5}, {"large"},
    ),
    "of equals the one that wastes least": (
        [has("three", 3), has("four", 4)], {"gib": 4}, {"three"},
    ),
    "lower priority before better size": (
        [has("exact", 3, priority=60), has("cheap", 4, priority=40)], {"gib": 4}, {"cheap"},
    ),
    "lower classes if they are enough": (WEAKER, {"gib": 4}, {"low", "mid"}),
    "a higher class if not": (WEAKER, {"gib": 5}, {"high"}),
    "idle before in use, even if more have to": (
        [has("a", 2), has("b", 2), has("busy", 4, used=True)], {"gib": 4}, {"a", "b"},
    ),
    "in vain: the idle one alone would not be enough": (
        [has("busy", 4, priority=90, used=True), has("idle", 2)], {"gib": 5}, set(),
    ),
    "a fresh one that would not help is not waited for": (
        [has("busy", 5, used=True), has("fresh", 0.5, min_residency_s=2.0)], {"gib": 4}, {"busy"},
    ),
    "exclusive empties the GPU": (
        [has("a", 1), has("b", 1)], {"gib": 1, "exclusive": True}, {"a", "b"},
    ),
    "exclusive, in vain: one stays": (
        [has("a", 1), has("busy", 1, priority=90, used=True)], {"gib": 1, "exclusive": True}, set(),
    ),
    "an exclusive holder has to go for anyone": (
        [has("alone", 1, exclusive=True)], {"gib": 1}, {"alone"},
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", VICTIMS)
def test_who_is_asked(case: str) -> None:
    scene = Scene()
    holders, wish, asked = VICTIMS[case]
    for held in holders:
        scene.hold(**{key: value for key, value in held.items() if key != "used"})
        if held["used"]:
            scene.use(held["name"])
    assert scene.want(**wish) == asked
    assert scene.driver.state(scene.held["w"]) == ("loading" if case == "it fits" else "queued")
    if not asked:
        scene.driver.advance(1.0)
        assert scene.asked() == set()


PARKS = {"park_bytes": 3 * GIB}
ORDER: dict[str, tuple[dict[str, Any], dict[str, Any]]] = {
    "idle before in use": ({"used": True, "priority": 10}, {"priority": 20}),
    "lower priority before parking": ({"priority": 20, **PARKS}, {"priority": 10}),
    "parking before the last use": ({"last_at": 5.0}, {"last_at": 6.0, **PARKS}),
    "without host RAM for it": ({"last_at": 6.0, "park_bytes": 9 * GIB}, {"last_at": 5.0}),
    "the least recent use": ({"last_at": 6.0}, {"last_at": 5.0}),
}


@pytest.mark.parametrize("others", [0, 12])
@pytest.mark.parametrize("case", [*ORDER, "the oldest request"])
def test_which_of_two_alike_goes(case: str, others: int) -> None:
    """Beside a dozen others, which cost more, the search is greedy."""
    scene = Scene((6 + others) * GIB + d.RESERVE_BYTES, host_ram_budget_bytes=8 * GIB)
    holders: dict[str, dict[str, Any]] = {"goes": {"last_at": 5.0}, "stays": {"last_at": 5.0}}
    if case in ORDER:
        holders = dict(zip(("stays", "goes"), ORDER[case], strict=True))
    for name, traits in holders.items():
        spec = {key: value for key, value in traits.items() if key not in ("used", "last_at")}
        scene.hold(name, 3, **spec)
        lease = state_of(scene.driver.arbiter).leases[scene.held[name]]
        lease.uses.last_at = traits.get("last_at", lease.uses.last_at)
        if "used" in traits:
            scene.use(name)
    for number in range(others):
        scene.hold(f"other{number}", 1, priority=90)
    assert scene.want(2) == {"goes"}


def test_in_use_is_asked_when_nothing_else_helps_and_only_as_few_as_needed() -> None:
    scene = Scene()
    scene.hold("a", 2)
    scene.hold("busy1", 3)
    scene.hold("busy2", 3)
    scene.use("busy1")
    scene.use("busy2")
    assert scene.want(5) == {"a", "busy2"} or scene.asked() == {"a", "busy1"}


def test_a_holder_in_use_yields_only_to_its_priority_and_ageing_gets_there() -> None:
    scene = Scene()
    scene.hold("busy", 5, priority=52)
    scene.use("busy")
    assert scene.want(5) == set()
    scene.driver.advance(9.9)
    assert scene.asked() == set()
    scene.driver.advance(0.2)
    assert scene.asked() == {"busy"}, "two points are worth 10 s"


def test_an_idle_holder_yields_to_anybody_after_its_residency() -> None:
    scene = Scene()
    scene.hold("calm", 5, priority=90, min_residency_s=2.0)
    assert scene.want(5, priority=10) == set()
    scene.driver.advance(2.1)
    assert scene.asked() == {"calm"}


def test_a_residency_is_waited_for_rather_than_somebody_in_use_asked() -> None:
    scene = Scene()
    scene.hold("busy", 4)
    scene.use("busy")
    scene.hold("fresh", 4, min_residency_s=2.0)
    assert scene.want(4) == set()
    scene.driver.advance(2.1)
    assert scene.asked() == {"fresh"}


@pytest.mark.parametrize("count", [14, 20])
def test_many_holders_are_searched_greedily_and_nobody_goes_in_vain(count: int) -> None:
    scene = Scene(count * GIB // 4 + 2 * GIB + d.RESERVE_BYTES)
    for n in range(count):
        scene.hold(f"h{n}", 0.25)
    scene.hold("big", 1.5)
    asked = scene.want(2.0)
    assert asked == {"big"}
    scene = Scene(count * GIB // 4 + GIB // 8 + d.RESERVE_BYTES)
    for n in range(count):
        scene.hold(f"h{n}", 0.25)
    assert len(scene.want(0.5)) == 2, "an eighth is free: two quarters have to go"


def test_greedy_gives_back_who_is_not_needed() -> None:
    scene = Scene(16 * GIB + d.RESERVE_BYTES)
    for n in range(13):
        scene.hold(f"low{n}", 0.5, priority=10)
    scene.hold("high", 9, priority=20)
    assert scene.want(8.9) == {"high"}


DEBT: dict[str, Any] = {"confirmed_at": 100.001, "baseline_comparable": False}
ROOM: dict[str, tuple[dict[str, Any], int | None]] = {
    "what is free": ({}, 7 * GIB),
    "no reading": ({"gpu": {"sample": None}}, None),
    "a failed one since": ({"gpu": {"failed_at": 1.0}}, None),
    "old enough": ({"oldest": 100.0}, 7 * GIB),
    "too old": ({"oldest": 100.001}, None),
    "a smaller GPU than it was": ({"sample": {"total_bytes": 6 * GIB}}, 5 * GIB),
    "a cap": ({"sample": {"total_bytes": 9 * GIB}}, 7 * GIB),
    "ready as it began": ({"lease": {"ready_at": 100.0}}, 7 * GIB),
    "ready since: its load peak": ({"lease": {"ready_at": 100.001}}, 4 * GIB),
    "granted since": ({"lease": {"granted_at": 100.001}}, 4 * GIB),
    "ready since, and charged more": ({"lease": {"ready_at": 100.001}, "charge": 4}, 3 * GIB),
    "granted and lost since": ({"debt": {}}, None),
    "lost as it began": ({"debt": {"confirmed_at": 100.0}}, 7 * GIB),
    "lost since, and seen before": ({"debt": {"baseline_comparable": True}}, 7 * GIB),
    "released since": ({"debt": {"lease": LeaseId("L1-1")}}, 7 * GIB),
}


@pytest.mark.parametrize("case", ROOM)
def test_room_by_measurement(case: str) -> None:
    """A reading of 1 GiB began at 100 s; a lease of 2 GiB took 3 in its load before that."""
    changes, room = ROOM[case]
    scene = Scene(8 * GIB)
    lease = state_of(scene.driver.arbiter).leases[scene.hold("a", 3, steady_bytes=2 * GIB)]
    gpu = scene.gpu
    assert gpu.sample is not None
    sample = replace(gpu.sample, taken_at=100.0, used_bytes=GIB)
    gpu.sample = replace(sample, **changes.get("sample", {}))
    lease.granted_at = lease.ready_at = 90.0
    gpu.residents.recent[lease.id] = lease
    gpu.ledger.recharge(lease.id, changes.get("charge", 2) * GIB, 90.0)
    for record, fields in ((gpu, "gpu"), (lease, "lease")):
        for name, value in changes.get(fields, {}).items():
            setattr(record, name, value)
    if "debt" in changes:
        debt = {"lease": LeaseId("gone"), **DEBT, **changes["debt"]}
        rest = {"key": "gone", "process": lease.process, "consumer": "a", "model": "a m"}
        gone = Verification(**rest, **debt, retained_bytes=0, baseline=None, not_before=0.0)
        gpu.verifications["gone"] = gone
    assert admission.measured_room_bytes(gpu, changes.get("oldest", 90.0)) == room


def test_a_gpu_that_grants_nothing_names_the_first_of_its_reasons() -> None:
    scene = Scene()
    core, gpu = state_of(scene.driver.arbiter), scene.gpu
    loading = core.leases[scene.driver.consumer("a").acquire(1 * GIB)]
    sample, gpu.sample = gpu.sample, None
    core.serving, core.drain, gpu.failed_at, gpu.ledger.pressed = (
        False,
        Order("ops", "test"),
        1.0,
        True,
    )
    found = [core.blocked(gpu)]
    for owner, name, value in (
        (core, "serving", True),
        (core, "drain", None),
        (gpu, "failed_at", None),
        (gpu, "sample", sample),
        (gpu.residents, "by_state", {**gpu.residents.by_state, loading.state: {}}),
        (gpu.ledger, "pressed", False),
    ):
        setattr(owner, name, value)
        found.append(core.blocked(gpu))
    assert found == [
        Block.RECOVERING,
        Block.DRAINED,
        Block.UNREADABLE,
        Block.UNREAD,
        Block.LOADING,
        Block.PRESSURE,
        None,
    ]


@pytest.mark.parametrize(("more", "state"), [(0, "loading"), (1, "queued")])
def test_the_last_byte_is_granted_and_no_more(more: int, state: str) -> None:
    scene = Scene()
    scene.hold("busy", 5)
    scene.use("busy")
    lease = scene.driver.consumer("w").acquire(3 * GIB + more, priority=10)
    assert scene.driver.state(lease) == state


def test_the_measured_need_is_less_by_what_the_process_holds() -> None:
    scene = Scene()
    lease = scene.hold("a", 3, residue_bytes=450 * MIB)
    core = state_of(scene.driver.arbiter)
    inner: Lease = core.leases[lease]
    assert admission.measured_need_bytes(scene.gpu, inner) == 3 * GIB, (
        "beside a resident lease of its own: everything"
    )
    scene.people["a"].unload(lease)
    scene.driver.until(lambda: scene.driver.state(lease) == "over")
    scene.driver.advance(0.1)
    assert admission.measured_need_bytes(scene.gpu, inner) == 3 * GIB - 450 * MIB
    scene.driver.device.lists_processes = False
    scene.driver.advance(2.0)
    assert admission.measured_need_bytes(scene.gpu, inner) == 3 * GIB - 450 * MIB, (
        "by the books, without a list"
    )
    scene.people["b"] = scene.driver.consumer("b")
    other = scene.people["b"].acquire(1 * GIB)
    assert scene.driver.state(other) == "loading"
