"""Standby: who was revoked comes back by itself when there is room, never at anybody's cost,
or as soon as its holder wants it."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held, in_use, revoked, sent_away, shown
from vram_arbiter.arbiter.core import standby
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Request, Standby
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey

# -- there and back


def test_cancel_on_the_way_to_standby_is_heard(driver: CoreDriver) -> None:
    """Regression: it was refused while the bytes were measured, and the lease came back to a holder
    that did not want it."""
    det, lease, _, _ = revoked(driver)
    driver.device.lag_s = 0.5
    det.unload(lease)
    assert driver.state(lease) == "verifying"
    assert answer(det.cancel(lease)) == {"state": "verifying"}
    driver.until(lambda: driver.state(lease) == "over", limit_s=5.0)


def test_it_asks_nobody_to_leave(driver: CoreDriver) -> None:
    _, lease, policy, wanted = sent_away(driver)
    vlm = driver.consumer("vlm")
    vlm_lease = vlm.acquire(4 * GIB)
    driver.until(lambda: driver.state(wanted) == "revoking")
    policy.unload(wanted)
    driver.until(lambda: driver.state(vlm_lease) == "loading")
    vlm.load(vlm_lease)
    driver.advance(600.0)
    assert (driver.state(lease), driver.state(vlm_lease)) == ("standby", "held"), (
        "5 + 4 do not fit on 8"
    )
    (why,) = driver.why("det")["leases"]
    assert (why["state"], why["back"]) == ("standby", "no_room")


def test_it_never_delays_a_waiter(driver: CoreDriver) -> None:
    _, lease, policy, wanted = sent_away(driver)
    in_use(driver, "busy", 1)
    policy.use_begin(wanted)
    big = driver.consumer("big").acquire(7 * GIB)
    policy.use_end(wanted)
    policy.unload(wanted)
    driver.advance(60.0)
    assert driver.state(big) == "queued"
    assert driver.state(lease) == "standby", "5 would fit, but somebody waits"
    (why,) = driver.why("det")["leases"]
    assert (why["state"], why["back"], why["ahead"]) == ("standby", "behind", "big")


def test_it_waits_until_the_gpu_has_been_quiet(driver: CoreDriver) -> None:
    """Between two goals the policy is away for a moment only."""
    _, lease, policy, wanted = sent_away(driver, min_residency_s=2.0)
    policy.unload(wanted)
    driver.advance(1.0)
    (why,) = driver.why("det")["leases"]
    assert why["back"] == "quiet"
    assert 1.0 <= why["due_s"] < 2.0
    again = policy.acquire(5 * GIB)
    assert driver.state(again) == "loading", "the next goal does not wait for the detector"
    policy.load(again)
    policy.unload(again)
    driver.advance(1.9)
    assert driver.state(lease) == "standby"
    driver.until(lambda: driver.state(lease) == "loading", limit_s=0.2)


def test_the_end_of_the_quiet_needs_no_reading_to_be_noticed() -> None:
    driver = CoreDriver(8 * GIB, settings={"probe_period_s": 1000.0})
    _, lease, policy, wanted = sent_away(driver, min_residency_s=20.0)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=20.1)


def test_once_used_it_has_its_residency(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver, min_residency_s=2.0)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=3.0)
    det.load(lease)
    det.use_begin(lease)
    det.use_end(lease)
    policy.acquire(5 * GIB)
    driver.advance(1.0)
    assert driver.state(lease) == "held"
    driver.until(lambda: driver.state(lease) == "revoking", limit_s=1.1)


def all_away(
    driver: CoreDriver, boss_gib: float, **wanted: tuple[float, dict[str, Any]]
) -> dict[str, tuple[Consumer, LeaseId]]:
    """Several on standby, in this order of leaving, and the GPU is empty again; nobody is back
    before a second of quiet."""
    people = {
        name: held(driver, name, gib, standby=True, min_residency_s=1.0, **spec)
        for name, (gib, spec) in wanted.items()
    }
    boss = driver.consumer("boss")
    all_of_it = boss.acquire(int(boss_gib * GIB), priority=90)
    for person, lease in people.values():
        driver.until(lambda lease=lease: driver.state(lease) == "revoking")  # type: ignore[misc]
        person.unload(lease)
        driver.advance(0.2)
    boss.load(all_of_it)
    give_back(driver, boss, all_of_it)
    return people


def stay(driver: CoreDriver, gib: float) -> tuple[Consumer, LeaseId]:
    """Somebody who is resident and stays."""
    return held(driver, "stays", gib, evictable=False)


BUDGET = 8 * GIB - d.RESERVE_BYTES
TURNS: dict[str, tuple[dict[str, Any], bool]] = {
    "the older request": ({}, True),
    "the later of two requests": ({"request": {"arrival": 9}}, False),
    "away for less long": ({"standby": {"since": 5.1}}, False),
    "a higher priority": ({"spec": {"priority": 51}, "standby": {"since": 5.1}}, True),
    "a lower priority": ({"spec": {"priority": 49}}, False),
    "wanted by its holder alone": ({"standby": {"comes_back": False}}, False),
    "its holder is not back": ({"attached": False}, False),
    "of another GPU": ({"request": {"gpus": ()}}, False),
    "as large as the GPU": ({"request": {"load_peak_bytes": BUDGET}}, True),
    "larger than the GPU": ({"request": {"load_peak_bytes": BUDGET + 1}}, False),
    "left for one that is here": ({"standby": {"left_for": "stays"}}, False),
    "left for another": ({"standby": {"left_for": "det"}}, True),
}


@pytest.mark.parametrize("case", TURNS)
def test_whose_turn_it_is_to_come_back(driver: CoreDriver, case: str) -> None:
    """Of two that are away, one is as in the case and the other is next."""
    changes, first = TURNS[case]
    core = state_of(driver.arbiter)
    gpu = core.gpus[GpuId("GPU-0")]
    if "left_for" in changes.get("standby", {}):
        held(driver, "stays", 1)
    found = []
    for arrival, parts in ((7, changes), (8, {})):
        person = driver.consumer(f"n{arrival}")
        request = Request("n", 0.0, arrival, GIB, GIB, (gpu.info.id,))
        away = Standby(comes_back=True, since=5.0)
        lease = Lease(
            LeaseId(person.name),
            replace(person.spec(GIB), **parts.get("spec", {})),
            person.process,
            person.client,
            replace(request, **parts.get("request", {})),
            state=LeaseState.STANDBY,
            attached=parts.get("attached", True),
            standby=replace(away, **parts.get("standby", {})),
        )
        found.append(lease)
    next_one = standby.first_to_return({lease.id: lease for lease in reversed(found)}, gpu)
    assert next_one is found[0 if first else 1]


@pytest.mark.parametrize(("changed_at", "since", "at"), [(7.0, 5.0, 9.0), (5.0, 7.0, 9.0)])
def test_a_gpu_is_quiet_once_nothing_changed_for_the_residency(
    driver: CoreDriver, changed_at: float, since: float, at: float
) -> None:
    _, lease = held(driver, "det", 1, min_residency_s=2.0)
    core = state_of(driver.arbiter)
    gpu, one = core.gpus[GpuId("GPU-0")], core.leases[lease]
    gpu.changed_at, one.standby.since = changed_at, since
    assert standby.quiet_at(gpu, one) == at


def test_a_small_one_does_not_take_the_place_of_the_one_before_it(driver: CoreDriver) -> None:
    people = all_away(driver, 7, det=(5.2, {}), tiny=(2.4, {}))
    driver.device.set(ProcessKey(9, 9), 1 * GIB, driver.now)
    other, resident = stay(driver, 2)
    driver.advance(20.0)
    assert driver.state(people["det"][1]) == "standby", "5.2 do not fit beside 2 and a stowaway"
    assert driver.state(people["tiny"][1]) == "standby", "2.4 would, but then the 5.2 never could"
    (why,) = driver.why("tiny")["leases"]
    assert why["back"] == "reading"
    other.unload(resident)
    driver.until(lambda: driver.state(people["det"][1]) == "loading", limit_s=2.0)


def test_a_small_one_does_not_pass_an_exclusive_one(driver: CoreDriver) -> None:
    people = all_away(driver, 7, det=(5, {"priority": 60}), tiny=(1, {}))
    det, alone = people["det"]
    det.try_acquire(5 * GIB, exclusive=True, standby=True, min_residency_s=1.0, priority=60)
    det.load(alone)
    wanted = driver.consumer("boss").acquire(7 * GIB, priority=90)
    driver.until(lambda: driver.state(alone) == "revoking")
    det.unload(alone)
    driver.until(lambda: driver.state(wanted) == "loading")
    driver.advance(0.1)
    driver.post(ProcessDied(driver.arbiter.inspect().leases[wanted].process))
    _, resident = stay(driver, 4)
    driver.advance(20.0)
    assert [driver.state(lease) for lease in (alone, people["tiny"][1], resident)] == [
        "standby",
        "standby",
        "held",
    ]


def test_several_that_do_not_fit_keep_their_turns(driver: CoreDriver) -> None:
    people = all_away(driver, 7.5, det=(4, {}), vlm=(3, {}), tiny=(0.5, {}))
    other, resident = stay(driver, 6)
    driver.until(lambda: driver.state(people["tiny"][1]) == "loading", limit_s=3.0)
    people["tiny"][0].load(people["tiny"][1])
    assert driver.state(people["det"][1]) == driver.state(people["vlm"][1]) == "standby"
    other.unload(resident)
    driver.until(lambda: driver.state(people["det"][1]) == "loading", limit_s=3.0)


def test_who_leaves_unasked_does_not_want_back(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, standby=True)
    give_back(driver, det, lease)
    assert driver.journal == {}


def test_who_exits_does_not_come_back(driver: CoreDriver) -> None:
    det, lease, _, _ = revoked(driver)
    det.hold(0)
    det.release(lease, exiting=True)
    driver.until(lambda: driver.state(lease) == "over")
    assert f"lease:{lease}" not in driver.journal


def test_pressure_sends_on_standby_too_and_lets_back_when_it_is_over(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, standby=True)
    game = driver.consumer("game")
    driver.device.set(game.process, 4 * GIB, driver.now)
    driver.until(lambda: driver.state(lease) == "revoking", limit_s=5.0)
    det.unload(lease)
    driver.until(lambda: driver.state(lease) == "standby")
    driver.advance(5.0)
    assert driver.state(lease) == "standby"
    driver.device.set(game.process, 0, driver.now)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=5.0)


def test_a_blocked_gpu_brings_nobody_back(driver: CoreDriver) -> None:
    _, lease, policy, wanted = sent_away(driver)
    policy.unload(wanted)
    driver.device.failing = "NVML_ERROR_UNKNOWN"
    driver.advance(20.0)
    assert driver.state(lease) == "standby"
    (why,) = driver.why("det")["leases"]
    assert (why["back"], why["block"]["code"]) == ("blocked", "unreadable")
    driver.device.failing = ""
    driver.until(lambda: driver.state(lease) == "loading", limit_s=5.0)


def test_the_reading_has_to_agree_before_it_comes_back(driver: CoreDriver) -> None:
    driver.device.lag_s = 1.0
    _, lease, policy, wanted = sent_away(driver)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    assert sum(driver.device.shown(driver.now).values()) == 0


# -- wanted now
def test_reacquire_with_room_is_answered_at_once(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver, min_residency_s=20.0)
    policy.unload(wanted)
    driver.advance(1.0)
    told = answer(det.reacquire(lease))
    assert told["state"] == "loading"
    assert told["lease"]["token"] == [*told["lease"]["token"]]
    det.load(lease)
    assert refusal(det.reacquire(lease)).code == "bad_state"


def test_a_late_repeat_of_reacquire_asks_for_nothing(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    old = det.token(lease)
    det.reacquire(lease)
    again = answer(det.reacquire(lease))
    assert (again["state"], again["lease"]["position"]) == ("queued", 1)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    det.load(lease)
    assert refusal(det.reacquire(lease, token=old)).code == "stale_token"
    thief = driver.consumer("thief")
    assert refusal(thief.reacquire(lease)).code == "not_permitted"


def test_reacquire_on_the_way_out_waits_for_the_verdict(driver: CoreDriver) -> None:
    det, lease, _, wanted = revoked(driver)
    assert refusal(det.reacquire(lease)).code == "bad_state", "it has not let go"
    det.unload(lease)
    assert answer(det.reacquire(lease, wait_timeout_s=30.0))["state"] == "queued"
    assert driver.state(lease) == "verifying"
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(lease) == "queued"
    driver.advance(31.0)
    assert driver.pushes("denied", lease)[-1]["error"]["code"] == "wait_timeout"
    assert driver.state(lease) == "over"
    assert f"lease:{lease}" not in driver.journal


def test_reacquire_of_what_is_not_coming_back_is_refused(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    det.unload(lease)
    assert refusal(det.reacquire(lease)).code == "bad_state"


def test_reacquire_that_can_never_fit_changes_nothing(driver: CoreDriver) -> None:
    """It was granted once; after a restart there is a smaller GPU."""
    det, lease, policy, wanted = revoked(driver)
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    token = det.token(lease)
    policy.die()
    driver.shrink(driver.device.gpu, 4 * GIB)
    driver.restart()
    det.connect()
    answer(det.reattach(lease, token, away=True))
    assert refusal(det.reacquire(lease)).code == "vram_insufficient"
    assert driver.state(lease) == "standby"


def test_a_full_queue_refuses_reacquire_too() -> None:
    driver = CoreDriver(8 * GIB, settings={"waiters_max": 1})
    det, lease, policy, wanted = sent_away(driver)
    policy.use_begin(wanted)
    driver.consumer("x").acquire(5 * GIB)
    assert refusal(det.reacquire(lease)).code == "limit_exceeded"
    assert driver.state(lease) == "standby"


def test_a_new_acquire_of_the_same_model_takes_the_lease_over(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    told = answer(det.try_acquire(4 * GIB, nonce="again", standby=True, priority=70))
    assert (told["state"], told["lease"]["lease_id"], told["lease"]["priority"]) == (
        "queued",
        lease,
        70,
    )
    assert answer(det.try_acquire(4 * GIB, nonce="again"))["lease"]["lease_id"] == lease, "a repeat"
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    view = shown(driver, lease)
    assert view["charge_bytes"] == 4 * GIB, "as it is asked for now"
    other = answer(det.try_acquire(1 * GIB, key="another"))
    assert other["lease"]["lease_id"] != lease


def test_a_lease_that_was_taken_over_comes_back_as_it_was_asked_for_last() -> None:
    """Regression: the journal knew the spec of before, so after a restart 2 GiB were granted to a
    holder that loaded 6."""
    driver = CoreDriver(8 * GIB)
    det, lease, policy, wanted = sent_away(driver, gib=2, policy_gib=7)
    policy.use_begin(wanted)
    assert det.acquire(6 * GIB, standby=True) == lease
    assert driver.state(lease) == "queued"
    away, held = det.token(lease), policy.token(wanted)
    driver.restart()
    det.connect()
    policy.connect()
    det.reattach(lease, away, away=True)
    policy.reattach(wanted, held)
    assert driver.state(lease) == "standby", "the wait ended with the daemon"
    det.reacquire(lease)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    view = shown(driver, lease)
    assert view["charge_bytes"] == 6 * GIB


@pytest.mark.parametrize("reattaches", [True, False])
def test_whoever_asks_on_for_a_lease_that_he_took_over_waits_again(reattaches: bool) -> None:
    """Regression: a restart had ended the wait, and the repeat was told "standby", which its client
    took for a place in the queue."""
    driver = CoreDriver(8 * GIB)
    det, lease, policy, wanted = sent_away(driver)
    policy.use_begin(wanted)
    det.try_acquire(4 * GIB, nonce="again", standby=True)
    assert driver.state(lease) == "queued"
    away, held = det.token(lease), policy.token(wanted)
    driver.restart()
    det.connect()
    policy.connect()
    policy.reattach(wanted, held)
    if reattaches:
        det.reattach(lease, away, away=True)
    assert driver.state(lease) == "standby"
    assert answer(det.try_acquire(4 * GIB, nonce="again", standby=True))["state"] == "queued"
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=5.0)
    det.load(lease)
    assert answer(det.try_acquire(4 * GIB, nonce="again", standby=True))["state"] == "loading"


def there_and_back(
    driver: CoreDriver, det: Consumer, lease: LeaseId, policy: Consumer, wanted: LeaseId, nonce: str
) -> LeaseId:
    """The detector takes its lease over, and leaves again for the next lease of the policy."""
    det.try_acquire(5 * GIB, nonce=nonce, standby=True)
    driver.until(lambda: driver.state(wanted) == "revoking")
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    det.load(lease)
    following = policy.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(following) == "loading")
    policy.load(following)
    return following


def test_late_repeats_of_earlier_acquires_never_call_it_back() -> None:
    driver = CoreDriver(8 * GIB, settings={"waiters_max": 64})
    det, lease, policy, wanted = sent_away(driver)
    for turn in range(12):
        wanted = there_and_back(driver, det, lease, policy, wanted, f"turn{turn}")
    told = answer(det.try_acquire(5 * GIB, nonce="turn5", standby=True))
    assert (told["state"], told["lease"]["lease_id"]) == ("standby", lease)
    assert driver.state(wanted) == "held"
    det.cancel(lease)
    core = driver.arbiter.inspect()
    for turn in range(1100):
        (nonce,) = [f"filler{turn}"]
        filler = det.try_acquire(8 * GIB - 300 * MIB - turn, nonce=nonce, key=nonce)
        det.cancel(LeaseId(answer(filler)["lease"]["lease_id"]))
    assert (det.process, "turn11") not in core.nonces
    assert (det.process, "turn5") not in core.nonces, "forgotten with the lease"
