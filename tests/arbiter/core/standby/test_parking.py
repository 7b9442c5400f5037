"""Parked leases: off the GPU, weights in host RAM within one budget, charged the residue there and
nothing twice."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.scenes import give_back, held, shown
from vram_arbiter.arbiter.core.ledger import HostRam
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId

RESIDUE = 450 * MIB


def driver_with(budget_gib: float = 16, **more: Any) -> CoreDriver:
    return CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": int(budget_gib * GIB)}, **more)


def revoked_vlm(
    driver: CoreDriver, park_gib: float = 5, **spec: Any
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """A VLM that was revoked, and who asked for its room."""
    vlm, lease = held(
        driver, "vlm", 5, park_bytes=int(park_gib * GIB), residue_bytes=RESIDUE, **spec
    )
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    return vlm, lease, policy, wanted


def parked(driver: CoreDriver, **spec: Any) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    vlm, lease, policy, wanted = revoked_vlm(driver, **spec)
    vlm.unload(lease, parked=True)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    driver.advance(0.01)
    return vlm, lease, policy, wanted


def ram(driver: CoreDriver) -> int:
    shown: int = driver.status()["host_ram"]["parked_bytes"]
    return shown


# -- the budget
def test_the_budget_by_itself() -> None:
    a, b = LeaseId("a"), LeaseId("b")
    ram = HostRam(10)
    assert ram.book(a, 6)
    assert not ram.book(b, 5)
    assert ram.book(a, 5)
    assert ram.book(b, 5)
    assert not ram.book(b, 0)
    assert ram.taken_bytes() == 10
    ram.free(a)
    ram.find(a, 7)
    assert (ram.taken_bytes(), ram.found) == (12, {a})
    assert not ram.fits(b, 4)
    assert ram.fits(b, 3)


def test_room_is_kept_from_the_revoke_until_it_lets_go() -> None:
    driver = driver_with(8)
    vlm, lease, _, _ = revoked_vlm(driver)
    assert driver.pushes("revoke", lease)[-1]["park"] is True
    assert ram(driver) == 5 * GIB
    other, second = held(driver, "other", 1, park_bytes=4 * GIB)
    other.unloading(second)
    short = refusal(other.release(second, parked=True))
    assert short.code == "host_ram_insufficient"
    assert short.details == {
        "needed_bytes": 4 * GIB,
        "budget_bytes": 8 * GIB,
        "booked_bytes": 5 * GIB,
    }
    assert driver.state(second) == "unloading", "nothing has changed"
    vlm.unload(lease)
    assert ram(driver) == 0, "it did not park after all"
    other.release(second, parked=True)
    driver.until(lambda: driver.state(second) == "parked")
    driver.until(lambda: driver.state(lease) == "over")


@pytest.mark.parametrize("budget_gib", [4, 0])
def test_without_room_the_revoke_says_so(budget_gib: int) -> None:
    driver = driver_with(budget_gib)
    vlm, lease, _, _ = revoked_vlm(driver)
    assert driver.pushes("revoke", lease)[-1]["park"] is False
    assert ram(driver) == 0
    assert refusal(vlm.release(lease, parked=True)).code == "host_ram_insufficient"
    assert driver.state(lease) == "revoking"


def test_who_declared_nothing_cannot_park_and_who_exits_keeps_nothing() -> None:
    driver = driver_with()
    person, lease = held(driver, "plain", 2)
    undeclared = refusal(person.release(lease, parked=True))
    assert (undeclared.code, "park_bytes" in undeclared.message) == ("bad_state", True)
    other, second = held(driver, "other", 2, park_bytes=2 * GIB)
    assert refusal(other.release(second, parked=True, exiting=True)).code == "bad_state"
    assert driver.state(lease) == driver.state(second) == "held"


# -- away and back
def test_parked_it_is_charged_its_residue_on_the_gpu_and_its_weights_in_ram() -> None:
    driver = driver_with()
    vlm, lease, policy, wanted = parked(driver)
    view = shown(driver, lease)
    assert (view["state"], view["charge_bytes"], view["parked_bytes"]) == ("parked", 0, 5 * GIB)
    assert driver.gpu()["charged_bytes"] == 5 * GIB + RESIDUE
    assert driver.notes("parked")[-1]["comes_back"] is False
    driver.advance(600.0)
    policy.unload(wanted)
    driver.advance(10.0)
    assert driver.state(lease) == "parked", "it is not on standby"
    (why,) = driver.why("vlm")["leases"]
    assert (why["state"], why["back"]) == ("parked", "asked")
    assert answer(vlm.reacquire(lease))["state"] == "loading"
    assert driver.gpu()["charged_bytes"] == 5 * GIB, (
        "the load peak with the residue folded, as ever"
    )
    assert ram(driver) == 5 * GIB, "the copy is there until the weights are on the GPU"
    vlm.load(lease)
    assert ram(driver) == 0
    assert "parked_bytes" not in (driver.view(lease) or {})


def test_parked_and_on_standby_it_comes_back_by_itself() -> None:
    driver = driver_with()
    vlm, lease, policy, wanted = parked(driver, standby=True)
    assert driver.state(lease) == "parked"
    assert driver.notes("parked")[-1]["comes_back"] is True
    (why,) = driver.why("vlm")["leases"]
    assert (why["state"], why["back"], why["ahead"]) == ("parked", "left_for", "policy")
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=1.0)
    vlm.load(lease)
    assert ram(driver) == 0


def test_a_load_from_ram_that_fails_may_stay_parked_or_end() -> None:
    """cuda-checkpoint#44: a restore that fails must not be the end of everything."""
    driver = driver_with()
    vlm, lease, policy, wanted = parked(driver)
    give_back(driver, policy, wanted)
    vlm.reacquire(lease)
    vlm.release(lease, parked=True)
    driver.until(lambda: driver.state(lease) == "parked", limit_s=30.0)
    vlm.reacquire(lease)
    driver.until(lambda: driver.state(lease) == "loading")
    vlm.release(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=30.0)
    assert ram(driver) == 0


def test_reacquire_on_the_way_to_ram() -> None:
    driver = driver_with()
    vlm, lease, _, wanted = revoked_vlm(driver)
    vlm.unload(lease, parked=True)
    assert answer(vlm.reacquire(lease))["state"] == "queued"
    driver.until(lambda: driver.state(wanted) == "loading")
    assert (driver.state(lease), ram(driver)) == ("queued", 5 * GIB)


def test_giving_up_frees_the_ram() -> None:
    for end in ("cancel", "bye", "death", "timeout", "bye while measured", "death while measured"):
        driver = driver_with()
        vlm, lease, policy, wanted = revoked_vlm(driver)
        vlm.unload(lease, parked=True)
        if "measured" not in end:
            # run at once
            driver.until(lambda: driver.state(wanted) == "loading")  # noqa: B023
            policy.load(wanted)
        assert ram(driver) == 5 * GIB
        if end == "cancel":
            vlm.cancel(lease)
        elif end.startswith("bye"):
            vlm.leave()
        elif end.startswith("death"):
            vlm.die()
        else:
            policy.use_begin(wanted)
            vlm.reacquire(lease, wait_timeout_s=1.0)
            driver.advance(1.1)
        assert ram(driver) == 0, end
        driver.until(lambda: driver.state(lease) == "over")  # noqa: B023  # reason: run at once
        driver.advance(1.0)
        assert f"lease:{lease}" not in driver.journal, end


def test_a_lease_that_expires_while_asked_frees_its_booking() -> None:
    driver = driver_with()
    _, lease, _, _ = revoked_vlm(driver, ttl_s=10.0)
    driver.advance(11.0)
    assert driver.state(lease) == "over"
    assert ram(driver) == 0


def test_an_operator_keeps_a_parked_one_from_coming_back_by_itself() -> None:
    driver = driver_with()
    vlm, lease, policy, wanted = parked(driver, standby=True)
    ops = driver.consumer("ops")
    ops.order("evict", lease)
    assert driver.notes("operator")[-1]["action"] == "evict"
    assert driver.journal[f"lease:{lease}"].get("comes_back", False) is False
    policy.unload(wanted)
    driver.advance(20.0)
    assert driver.state(lease) == "parked"
    assert answer(vlm.reacquire(lease))["state"] == "loading"


# -- restarts
def test_a_restart_keeps_what_is_parked_and_what_is_promised() -> None:
    driver = driver_with(11)
    vlm, lease, policy, wanted = parked(driver)
    other, second = held(driver, "other", 1, park_bytes=6 * GIB)
    driver.consumer("big").acquire(7 * GIB)
    driver.until(lambda: driver.state(second) == "revoking")
    assert driver.pushes("revoke", second)[-1]["park"] is True
    tokens = {x: p.token(x) for p, x in ((vlm, lease), (policy, wanted), (other, second))}
    driver.restart()
    assert ram(driver) == 11 * GIB
    for person, x in ((policy, wanted), (other, second)):
        person.connect()
        person.reattach(x, tokens[x])
    vlm.connect()
    (kept,) = answer(vlm.reattach(lease, tokens[lease], parked=True))["leases"]
    assert (kept["lease"]["state"], kept["lease"]["parked_bytes"]) == ("parked", 5 * GIB)
    other.unload(second, parked=True)
    driver.until(lambda: driver.state(second) == "parked")


def test_a_smaller_budget_after_a_restart_is_no_violation_and_admits_nobody() -> None:
    driver = driver_with(5)
    vlm, lease, policy, wanted = parked(driver)
    tokens = vlm.token(lease), policy.token(wanted)
    driver.settings = replace(driver.settings, host_ram_budget_bytes=2 * GIB)
    driver.restart()
    policy.connect()
    policy.reattach(wanted, tokens[1])
    vlm.connect()
    vlm.reattach(lease, tokens[0], parked=True)
    assert ram(driver) == 5 * GIB
    other, second = held(driver, "other", 1, park_bytes=1 * GIB)
    assert refusal(other.release(second, parked=True)).code == "host_ram_insufficient"


def test_a_release_that_was_lost_is_made_up_for() -> None:
    driver = driver_with()
    other, resident = held(driver, "other", 1)
    vlm, lease, _, _ = revoked_vlm(driver)
    token, other_token = vlm.token(lease), other.token(resident)
    vlm.hold(RESIDUE)
    driver.restart()
    other.connect()
    other.reattach(resident, other_token)
    vlm.connect()
    vlm.reattach(lease, token, parked=True)
    driver.until(lambda: driver.state(lease) == "parked")
    assert ram(driver) == 5 * GIB


def test_after_a_restart_its_holder_says_that_it_parked_and_not_an_empty_gpu() -> None:
    driver = driver_with()
    vlm, lease, _, _ = revoked_vlm(driver)
    token = vlm.token(lease)
    vlm.hold(0)
    driver.restart()
    assert (driver.state(lease), ram(driver)) == ("held", 5 * GIB)
    vlm.connect()
    vlm.reattach(lease, token, parked=True)
    driver.until(lambda: driver.state(lease) == "parked")
    driver.advance(20.0)
    assert driver.state(lease) == "parked"


@pytest.mark.parametrize("standby", [False, True])
def test_a_lost_journal_does_not_lose_it(standby: bool) -> None:
    driver = driver_with()
    vlm, lease, policy, wanted = parked(driver, standby=standby)
    tokens = vlm.token(lease), policy.token(wanted)
    driver.restart(keep_journal=False)
    vlm.connect()
    (kept,) = answer(vlm.reattach(lease, tokens[0], parked=True))["leases"]
    assert (kept["lease"]["state"], ram(driver)) == ("parked", 5 * GIB)
    policy.connect()
    policy.reattach(wanted, tokens[1])
    driver.advance(16.0)
    policy.unload(wanted)
    driver.advance(5.0)
    assert driver.state(lease) == ("loading" if standby else "parked")


def test_a_holder_that_parked_unasked_while_the_daemon_was_away_has_its_ram_counted() -> None:
    """It had not been asked to leave, so no room in RAM was booked before the restart."""
    driver = driver_with()
    vlm, lease = held(driver, "vlm", 5, park_bytes=5 * GIB, residue_bytes=RESIDUE)
    token = vlm.token(lease)
    vlm.hold(RESIDUE)
    driver.restart()
    assert ram(driver) == 0
    vlm.connect()
    vlm.reattach(lease, token, parked=True)
    assert ram(driver) == 5 * GIB
    driver.until(lambda: driver.state(lease) == "parked")
