"""What users of other arbiters suffer from, where leases park, stand by, grow and switch. Numbers
are those of the list of complaints."""

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.engine_state import state_of
from tests.support.scenes import charge, held
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

GIB, MIB = d.GIB, d.MIB


def alternate(driver: CoreDriver, seconds: float) -> int:
    """Two consumers with a request a second each, on a GPU for one of them. Returns how often they
    switched."""
    people = {name: driver.consumer(name) for name in ("a", "b")}
    leases: dict[str, LeaseId] = {}
    ends = driver.now + seconds
    while driver.now < ends:
        for name, person in people.items():
            state = driver.state(leases[name]) if name in leases else "over"
            if state == "over":
                leases[name] = person.acquire(5 * GIB)
            elif state == "loading":
                driver.advance(3.0)
                person.load(leases[name])
            elif state == "revoking":
                person.unload(leases[name])
        driver.advance(0.1)
    return sum(bool(note["switched"]) for note in driver.notes("switch"))


def test_4_two_models_that_are_wanted_alike_do_not_load_all_the_time() -> None:
    """llama-swap#612, #588: more time goes into swapping than into work."""
    calm = alternate(CoreDriver(8 * GIB), 120.0)
    frantic = alternate(CoreDriver(8 * GIB, settings={"thrash_hold_max_s": 0.0}), 120.0)
    assert 0 < calm < frantic
    assert calm <= 22, "at least half of the time they work"


def test_4_equals_take_turns_at_safe_points(driver: CoreDriver) -> None:
    """The second of two equals waited for ever. Each stays for its minimum residency at least, and
    finishes its use."""
    people = {name: driver.consumer(name) for name in ("a", "b")}
    leases = {name: one.acquire(5 * GIB, min_residency_s=2.0) for name, one in people.items()}
    for name, other in (("a", "b"), ("b", "a"), ("a", "b")):
        person, lease = people[name], leases[name]
        driver.until(lambda lease=lease: driver.state(lease) == "loading")
        person.load(lease)
        person.use_begin(lease)
        driver.advance(1.9)
        assert driver.state(lease) == "held"
        driver.until(lambda lease=lease: driver.state(lease) == "revoking")
        driver.advance(60.0)
        assert driver.state(leases[other]) == "queued", "it is in use"
        person.use_end(lease)
        person.unload(lease)
        leases[name] = person.acquire(5 * GIB, min_residency_s=2.0)


@pytest.mark.parametrize("priority", [0, 50])
def test_4_an_idle_holder_does_not_keep_a_gpu_for_minutes(priority: int) -> None:
    """aprender#3986: a lock held for 25 minutes at 97 % idle, six waiters. Whatever was learnt, the
    wait has a bound."""
    learnt = {
        name: {"load_s": 1000.0, "unload_s": 1000.0, "verify_s": 1000.0} for name in ("idle", "w")
    }
    driver = CoreDriver(8 * GIB, settings={"learnt": learnt})
    person, lease = held(driver, "idle", 5)
    core = state_of(driver.arbiter)
    core.costs.switches["idle", "w"] = core.costs.switches["w", "idle"] = driver.now
    waiter = driver.consumer("w").acquire(5 * GIB, priority=priority)
    assert driver.until(lambda: driver.state(lease) == "revoking") <= d.THRASH_HOLD_MAX_S + 0.1
    person.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=1.0)


def test_4_nobody_starves_behind_leases_that_come_back_by_themselves(driver: CoreDriver) -> None:
    """Standby leases that return all the time never stand in a waiter's way for longer than the
    load that is under way."""
    people = [held(driver, f"s{n}", 2, standby=True, min_residency_s=0.5) for n in range(3)]
    waiting = driver.consumer("low").acquire(7 * GIB, priority=0)
    began = driver.now
    while driver.state(waiting) == "queued" and driver.now - began < 30.0:
        for person, lease in people:
            if driver.state(lease) == "revoking":
                person.unload(lease)
            elif driver.state(lease) == "loading":
                person.load(lease)
        driver.advance(0.05)
    assert driver.state(waiting) == "loading"
    assert driver.now - began < 2.0


def test_6_the_single_coldest_that_covers_the_need_leaves() -> None:
    """oMLX#1970: evict the single coldest that covers the bytes, not a hand-written group."""
    driver = CoreDriver(16 * GIB)
    leases = {gib: held(driver, f"m{gib}", gib)[1] for gib in (2, 5, 4, 3)}
    driver.consumer("w").acquire(5 * GIB)
    assert [gib for gib, lease in leases.items() if driver.state(lease) == "revoking"] == [4]


def test_10_nothing_that_comes_back_touches_a_pinned_model(driver: CoreDriver) -> None:
    """llama.cpp PR#18373, llama-swap#1127."""
    det, lease = held(driver, "det", 4, standby=True)
    boss = driver.consumer("boss")
    wanted = boss.acquire(5 * GIB, evictable=False)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    boss.load(wanted)
    driver.advance(300.0)
    assert (driver.state(lease), driver.state(wanted)) == ("standby", "held")
    assert answer(det.reacquire(lease, wait_timeout_s=60.0))["state"] == "queued"
    driver.advance(30.0)
    assert (driver.state(lease), driver.state(wanted)) == ("queued", "held")
    assert driver.pushes("revoke", wanted) == []


def test_16_parked_is_charged_as_parked_and_resumed_as_resumed() -> None:
    """Berth v0.4.0-rc.3: a resumed waiter was charged the whole GPU, and a hold waited with
    nothing to drain."""
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 16 * GIB})
    vlm, lease = held(driver, "vlm", 3, park_bytes=3 * GIB, residue_bytes=450 * MIB)
    vlm.unload(lease, parked=True)
    driver.until(lambda: driver.state(lease) == "parked")
    assert driver.gpu()["charged_bytes"] == 450 * MIB
    _, other = held(driver, "det", 4)
    assert answer(vlm.reacquire(lease))["state"] == "loading", (
        "3 fit beside 4: nothing has to be revoked"
    )
    assert (charge(driver, lease), driver.gpu()["charged_bytes"]) == (3 * GIB, 7 * GIB)
    assert driver.state(other) == "held"


def test_18_a_restore_waits_until_the_room_is_measured() -> None:
    """cuda-checkpoint#44: a restore into memory that is not free yet hangs its process for ever."""
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 16 * GIB})
    driver.device.lag_s = 1.5
    vlm, lease = held(driver, "vlm", 5, park_bytes=5 * GIB)
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    vlm.unload(lease, parked=True)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    vlm.reacquire(lease)
    driver.until(lambda: driver.state(wanted) == "revoking")
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    assert sum(driver.device.shown(driver.now).values()) == 0


def test_19_a_model_that_cannot_be_moved_to_host_ram_is_never_told_to() -> None:
    """bitsandbytes#1815: `.to("cpu")` fails for NF4. Parking is declared by who can, not
    assumed."""
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 64 * GIB})
    nf4, lease = held(driver, "nf4", 5)
    driver.consumer("w").acquire(5 * GIB)
    assert driver.pushes("revoke", lease)[-1]["park"] is False
    assert refusal(nf4.release(lease, parked=True)).code == "bad_state"
    nf4.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")
