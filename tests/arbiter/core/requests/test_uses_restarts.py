"""Uses that others than the holder mark outlive the daemon: whoever is stopped across its restart
still keeps the holder from being evicted."""

from collections.abc import Sequence
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.scenes import held, shown
from vram_arbiter.arbiter.core.effects import Effect, JournalPut, Reply
from vram_arbiter.arbiter.core.events import ProcessDied, Resumed
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import LeaseId, Token

PATIENCE_S = d.LEASE_TTL_S + d.FENCE_GRACE_S


def used(
    driver: CoreDriver, uses: Sequence[str] = ("goal",), **spec: Any
) -> tuple[Consumer, LeaseId, Token, Consumer]:
    """A sidecar that holds 5 GiB, and a runner that uses it by its token."""
    sidecar, lease = held(driver, "sidecar", 5, **{"ttl_s": d.LEASE_TTL_S, **spec})
    runner = driver.consumer("runner")
    for use in uses:
        runner.use_begin(lease, use, label="grab")
    return sidecar, lease, sidecar.token(lease), runner


def restarted(
    driver: CoreDriver, sidecar: Consumer, lease: LeaseId, token: Token, epoch: int = 2
) -> None:
    """The daemon is killed and started again. The holder comes back at once."""
    driver.restart(epoch=epoch)
    sidecar.connect()
    sidecar.reattach(lease, token)


def live_on(
    driver: CoreDriver, sidecar: Consumer, lease: LeaseId, token: Token, seconds: float
) -> None:
    """Time passes, and the holder renews its lease."""
    until = driver.now + seconds
    while driver.now < until:
        sidecar.renew((lease, token))
        driver.advance(min(1.0, until - driver.now))


def writes(effects: list[Effect]) -> list[list[str]]:
    """Of each write of a lease, the uses that it names."""
    put = [effect.record for effect in effects if isinstance(effect, JournalPut)]
    leases = [record for record in put if isinstance(record, LeaseRecord)]
    return [[use for _, _, use, _ in record.users] for record in leases]


# -- after a restart
def test_a_user_that_is_stopped_across_a_restart_keeps_its_holder(driver: CoreDriver) -> None:
    """Regression: only its own client could mark the use again, and a holder was sent away in the
    middle of a grab."""
    sidecar, lease, token, runner = used(driver)
    restarted(driver, sidecar, lease, token)
    assert driver.status()["phase"] == "serving", "nobody waits for the user to come back"
    assert shown(driver, lease)["uses"] == 1
    vlm = driver.consumer("vlm").acquire(5 * GIB, priority=90)
    live_on(driver, sidecar, lease, token, PATIENCE_S - 1.0)
    assert driver.state(vlm) == "queued"
    assert refusal(sidecar.unloading(lease)).details["uses"] == 1, "not at a safe point"
    runner.connect()
    assert answer(runner.use_begin(lease, "goal", token))["uses"] == 1, "it is the same use"
    told = driver.notes("use_began")[-1]
    assert (told["label"], told["resumed"], told["uses"]) == ("grab", True, 1)
    live_on(driver, sidecar, lease, token, 2 * PATIENCE_S)
    assert shown(driver, lease)["uses"] == 1, "it was said again: its bound is that of any use"
    before = len(driver.notes("use_began"))
    runner.use_begin(lease, "goal", token)
    assert len(driver.notes("use_began")) == before, "a repeat is no news"
    runner.leave("gone")
    assert driver.notes("use_ended")[-1]["why"] == "client_left", "it is that client's now"
    sidecar.unload(lease)
    driver.until(lambda: driver.state(vlm) == "loading")


def test_a_user_that_dies_after_a_restart_leaves_the_holder_at_its_safe_point() -> None:
    driver = CoreDriver(8 * GIB)
    sidecar, lease, token, runner = used(driver)
    restarted(driver, sidecar, lease, token)
    driver.post(ProcessDied(runner.process))
    assert shown(driver, lease)["uses"] == 0
    assert driver.notes("use_ended")[-1]["why"] == "process_died"
    assert "users" not in driver.journal[f"lease:{lease}"]


def test_a_use_that_ended_while_the_daemon_was_away_is_over_when_its_process_says_so() -> None:
    driver = CoreDriver(8 * GIB)
    sidecar, lease, token, runner = used(driver)
    restarted(driver, sidecar, lease, token)
    runner.connect()
    assert answer(runner.use_end(lease, "goal", token))["uses"] == 0


@pytest.mark.parametrize(("ttl_s", "patience_s"), [(30.0, 35.0), (2.0, PATIENCE_S)])
def test_a_user_that_does_not_come_back_is_waited_for_as_long_as_a_silent_holder(
    driver: CoreDriver, ttl_s: float, patience_s: float
) -> None:
    sidecar, lease, token, _ = used(driver, ttl_s=ttl_s)
    driver.restart()
    began = driver.now - 0.01
    sidecar.connect()
    sidecar.reattach(lease, token)
    live_on(driver, sidecar, lease, token, began + patience_s - 0.001 - driver.now)
    assert shown(driver, lease)["uses"] == 1
    driver.advance(0.001)
    assert shown(driver, lease)["uses"] == 0
    assert driver.notes("use_ended")[-1]["why"] == "user_not_back"
    assert "users" not in driver.journal[f"lease:{lease}"]
    vlm = driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    sidecar.unload(lease)
    driver.until(lambda: driver.state(vlm) == "loading")


def test_only_the_user_that_did_not_come_back_is_given_up(driver: CoreDriver) -> None:
    sidecar, lease, token, runner = used(driver)
    driver.consumer("watcher").use_begin(lease, "watch", token)
    restarted(driver, sidecar, lease, token)
    runner.connect()
    runner.use_begin(lease, "goal", token)
    sidecar.use_begin(lease, "own", token)
    live_on(driver, sidecar, lease, token, PATIENCE_S)
    assert [note["use_id"] for note in driver.notes("use_ended")] == ["watch"]
    assert shown(driver, lease)["uses"] == 2
    assert writes(driver.effects)[-1] == ["goal"]


def test_a_suspend_after_the_restart_gives_the_user_its_whole_time_anew(driver: CoreDriver) -> None:
    sidecar, lease, token, _ = used(driver)
    restarted(driver, sidecar, lease, token)
    live_on(driver, sidecar, lease, token, PATIENCE_S - 1.0)
    driver.post(Resumed(3600.0))
    live_on(driver, sidecar, lease, token, PATIENCE_S - 0.001)
    assert shown(driver, lease)["uses"] == 1
    driver.advance(0.001)
    assert shown(driver, lease)["uses"] == 0
    driver.post(Resumed(3600.0))
    assert ("users", lease) not in driver.arbiter.inspect().timers, "nobody is waited for any more"


def test_a_holder_that_was_asked_and_is_used_is_not_taken_for_gone(driver: CoreDriver) -> None:
    """Regression: records written after a first restart forgot that the holder had been revoked,
    and a standby lease did not return."""
    sidecar, lease, token, runner = used(driver, standby=True)
    driver.consumer("vlm").acquire(5 * GIB, priority=90)
    assert driver.journal[f"lease:{lease}"]["state"] == "revoking"
    restarted(driver, sidecar, lease, token)
    assert refusal(sidecar.unloading(lease)).details["uses"] == 1
    driver.consumer("watcher").use_begin(lease, "watch", token)
    assert driver.journal[f"lease:{lease}"]["state"] == "revoking", (
        "the next daemon has to know it too"
    )
    restarted(driver, sidecar, lease, token, epoch=3)
    assert shown(driver, lease)["uses"] == 2
    driver.post(ProcessDied(runner.process))
    live_on(driver, sidecar, lease, token, PATIENCE_S)
    assert answer(sidecar.unload(lease))["next"] == "standby"


def test_a_record_of_an_older_daemon_names_no_users(driver: CoreDriver) -> None:
    sidecar, lease, token, _ = used(driver)
    record = dict(driver.journal[f"lease:{lease}"])
    del record["users"]
    driver.journal[f"lease:{lease}"] = record
    restarted(driver, sidecar, lease, token)
    assert (driver.state(lease), shown(driver, lease)["uses"]) == ("held", 0)


# -- what it costs
def test_the_holders_own_uses_are_not_written(driver: CoreDriver) -> None:
    sidecar, lease = held(driver, "sidecar", 5)
    for use in ("u1", "u2"):
        assert writes(sidecar.use_begin(lease, use)) == []
    for use in ("u1", "u2"):
        assert writes(sidecar.use_end(lease, use)) == []


def test_one_use_of_each_other_process_is_written_before_it_is_answered(driver: CoreDriver) -> None:
    sidecar, lease, token, runner = used(driver, ())
    sidecar.use_begin(lease, "own")
    effects = runner.use_begin(lease, "u1", token, "grab")
    kinds = [type(effect) for effect in effects]
    assert kinds.index(JournalPut) < kinds.index(Reply), "its user counts on it from then on"
    assert driver.journal[f"lease:{lease}"]["users"] == [[*_key(runner), "u1", "grab"]]
    assert writes(effects) == [["u1"]]
    assert writes(runner.use_begin(lease, "u1", token)) == [], "a repeat"
    assert writes(runner.use_begin(lease, "u2", token)) == [], "the process is known already"
    assert writes(runner.use_begin(lease, "u3", token)) == []
    assert writes(runner.use_end(lease, "u2", token)) == []
    watcher = driver.consumer("watcher")
    assert writes(watcher.use_begin(lease, "w1", token)) == [["u1", "w1"]]
    assert writes(runner.use_end(lease, "u1", token)) == [["u3", "w1"]], (
        "another of its uses runs on"
    )
    assert writes(watcher.leave("dropped")) == [["u3"]]
    assert writes(runner.use_end(lease, "u3", token)) == [[]]
    assert writes(runner.use_end(lease, "u3", token)) == []


def _key(person: Consumer) -> tuple[int, int]:
    return person.process.pid, person.process.start_ticks


def test_whatever_is_written_of_a_lease_names_its_users(driver: CoreDriver) -> None:
    sidecar, lease, token, runner = used(driver)
    sidecar.order("pin", lease, "", "ada")
    assert writes(driver.effects)[-1] == ["goal"]
    runner.use_end(lease, "goal", token)
    sidecar.unload(lease)
    assert writes(driver.effects)[-1] == []
