"""A restart of the daemon loses no lease on standby, at whichever step of its way it comes."""

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import held, revoked, sent_away, shown
from vram_arbiter.arbiter.core.effects import Push
from vram_arbiter.arbiter.core.events import ClientConnected, Recovered
from vram_arbiter.arbiter.host.records import records_of
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ClientId, Token
from vram_arbiter.schemas.wire.pushes import GrantedPush


def test_a_restart_keeps_it_and_waits_for_its_holder(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver, ttl_s=10.0)
    token, policy_token = det.token(lease), policy.token(wanted)
    driver.restart()
    policy.connect()
    policy.reattach(wanted, policy_token)
    policy.unload(wanted)
    driver.advance(1.0)
    assert driver.state(lease) == "standby", "its holder has not come back"
    (why,) = driver.why("det")["leases"]
    assert why["back"] == "holder"
    det.connect()
    (kept,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert (kept["kept"], kept["lease"]["state"]) == (True, "standby")
    driver.until(lambda: driver.state(lease) == "loading", limit_s=1.0)
    det.load(lease)
    driver.advance(60.0)


@pytest.mark.parametrize("found", ["standby", "verifying", "never measured"])
def test_a_holder_that_does_not_come_back_loses_it(driver: CoreDriver, found: str) -> None:
    """One that was away only after the restart had no time to come back in: it kept its host RAM
    for ever."""
    det, lease, _, _ = revoked(driver, ttl_s=10.0)
    det.unload(lease)
    if found == "standby":
        driver.until(lambda: driver.state(lease) == found)
    driver.device.silent = found == "never measured"
    driver.restart()
    driver.advance(14.9)
    assert driver.state(lease) == ("verifying" if driver.device.silent else "standby")
    driver.advance(0.2)
    driver.device.silent = False
    driver.until(lambda: driver.state(lease) == "over")
    assert f"lease:{lease}" not in driver.journal


def test_who_asks_for_it_anew_before_re_attaching_has_come_back(driver: CoreDriver) -> None:
    """After a restart it asks for the model again, and waits for longer than a holder has time to
    come back."""
    det, lease, policy, wanted = sent_away(driver, ttl_s=10.0)
    policy_token = policy.token(wanted)
    driver.restart()
    policy.connect()
    policy.reattach(wanted, policy_token)
    policy.use_begin(wanted)
    det.connect()
    assert det.acquire(5 * GIB, standby=True, ttl_s=10.0) == lease
    for _ in range(10):
        policy.renew((wanted, policy.token(wanted)))
        driver.advance(2.5)
    assert driver.state(lease) == "queued"
    policy.use_end(wanted)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=1.0)


def test_only_leases_on_standby_in_the_journal_hold_up_nobody(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    policy.unload(wanted)
    driver.advance(0.0)
    policy.die()
    token = det.token(lease)
    records = {key: record for key, record in driver.journal.items() if key == f"lease:{lease}"}
    fresh = CoreDriver(8 * GIB)
    fresh.post(Recovered(records_of(records)))
    assert fresh.status()["phase"] == "serving"
    assert fresh.state(lease) == "standby"
    assert token == Token(1, 2)


def test_a_restart_in_the_middle_of_the_way_out_does_not_make_it_a_wish(driver: CoreDriver) -> None:
    """The holder was asked before the restart and lets go after it: it still comes back."""
    det, lease, policy, wanted = revoked(driver)
    token = det.token(lease)
    driver.restart()
    assert driver.state(lease) == "held", (
        "not asked by this daemon: uses of others may be on their way back"
    )
    det.connect()
    det.reattach(lease, token)
    wanted = policy.acquire(5 * GIB) if policy.connect() is not None else None
    assert wanted is not None
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(lease) == "standby"


def test_a_restart_does_not_let_a_revoke_outrun_the_uses_of_others(driver: CoreDriver) -> None:
    """Regression: a lease restored as asked to leave refused the runner's goal, and unloaded in the
    middle of the grab."""
    policy, lease = held(driver, "policy", 5, standby=True)
    runner = driver.consumer("runner")
    token = policy.token(lease)
    runner.use_begin(lease, "grab", token)
    driver.consumer("vlm").acquire(5 * GIB, priority=60)
    driver.until(lambda: driver.state(lease) == "revoking")
    assert driver.journal[f"lease:{lease}"]["state"] == "revoking"
    driver.restart()
    policy.connect()
    policy.reattach(lease, token)
    runner.connect()
    assert answer(runner.use_begin(lease, "grab", token))["uses"] == 1
    assert refusal(policy.unloading(lease)).code == "bad_state"
    runner.use_end(lease, "grab", token)
    policy.unload(lease)
    driver.until(lambda: bool(driver.notes("standby")))


def test_a_restart_during_the_measurement(driver: CoreDriver) -> None:
    driver.device.lag_s = 0.5
    det, lease, _, _ = revoked(driver)
    token = det.token(lease)
    det.unload(lease)
    driver.restart()
    assert driver.state(lease) == "verifying"
    det.connect()
    det.reattach(lease, token, away=True)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert driver.notes("standby")[-1]["left_for"] == "policy"


def test_a_release_that_was_lost_is_made_up_for(driver: CoreDriver) -> None:
    """The daemon died with the release in its socket: the holder says that it let go."""
    det, lease, _, _ = revoked(driver)
    token = det.token(lease)
    other, resident = held(driver, "other", 1)
    driver.advance(0.01)
    det.hold(0)
    other_token = other.token(resident)
    driver.restart()
    other.connect()
    other.reattach(resident, other_token)
    det.connect()
    (kept,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert kept["lease"]["state"] == "verifying"
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert len(driver.notes("standby")) == 1


def test_after_a_restart_its_holder_says_that_it_left_and_not_an_empty_gpu() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, _, _ = revoked(driver)
    token = det.token(lease)
    det.hold(0)
    driver.restart()
    driver.advance(0.2)
    assert driver.state(lease) == "held"
    det.connect()
    det.reattach(lease, token, away=True)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert len(driver.notes("standby")) == 1


def test_a_grant_that_its_holder_missed_is_said_again(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    token = det.token(lease)
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=1.0)
    driver.effects.clear()
    det.client = ClientId("c-new")
    driver.post(ClientConnected(det.client, det.process, 1000, det.name, f"{det.name}-c101"))
    (kept,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert kept["lease"]["state"] == "loading"
    (granted,) = driver.pushes("granted", lease)
    assert granted["lease"]["token"] == kept["lease"]["token"]
    thief = driver.consumer("thief")
    spec = det.specs[lease]
    answers = answer(thief.reattach(lease, token, away=True, spec=spec))["leases"]
    assert answers[0]["error"]["code"] == "stale_token"
    answers = answer(det.reattach(lease, token))["leases"]
    assert answers[0]["error"]["code"] == "stale_token", "to say that it is held takes its token"
    det.load(lease)


def test_one_that_is_queued_again_re_attaches_as_it_is(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    policy.use_begin(wanted)
    det.reacquire(lease)
    (kept,) = answer(det.reattach(lease, det.token(lease), away=True))["leases"]
    assert kept["lease"]["state"] == "queued"


def test_a_lost_journal_does_not_lose_it_either(driver: CoreDriver) -> None:
    det, lease, policy, wanted = sent_away(driver)
    token, policy_token = det.token(lease), policy.token(wanted)
    driver.restart(keep_journal=False)
    det.connect()
    policy.connect()
    policy.reattach(wanted, policy_token)
    (kept,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert (kept["lease"]["state"], "parked_bytes" in kept["lease"]) == ("standby", False)
    assert driver.journal[f"lease:{lease}"]["state"] == "standby"
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    policy.unload(wanted)
    driver.advance(20.0)
    assert driver.state(lease) == "loading"


def test_a_held_lease_that_the_journal_lost_still_goes_on_standby(driver: CoreDriver) -> None:
    """The feature watches what a holder brings back, not only what it saw asked for."""
    det, lease = held(driver, "det", 5, standby=True)
    token = det.token(lease)
    driver.restart(keep_journal=False)
    det.connect()
    det.reattach(lease, token)
    view = shown(driver, lease)
    assert view["standby"] is True
    driver.advance(20.0)  # holders that the lost journal did not name had their time
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(lease) == "standby")
    driver.until(lambda: driver.state(wanted) == "loading")


def test_a_return_that_cannot_be_journalled_is_not_made(driver: CoreDriver) -> None:
    _, lease, policy, wanted = sent_away(driver, min_residency_s=1.0)
    policy.unload(wanted)
    driver.advance(0.5)
    driver.journal_failing = "disk full"
    driver.advance(1.0)
    assert driver.state(lease) == "over"
    assert driver.pushes("denied", lease)[-1]["error"]["code"] == "journal_unavailable"
    assert not any(
        isinstance(e, Push) and isinstance(e.body, GrantedPush) for e in driver.effects[-20:]
    )
    assert driver.gpu()["charged_bytes"] == 0
