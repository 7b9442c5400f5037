"""A sidecar that was evicted and is on standby: it comes back by itself, or as soon as it may when
somebody wants it."""

import os
import signal

import pytest

from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient

pytestmark = pytest.mark.e2e

DETECTOR = ("--standby", "--min-residency-s", "0")
BOTH = "5GB,5GB,100MB"  # each fits, both together do not


def state(arbiter, consumer):
    return next(
        (
            lease["state"]
            for lease in arbiter.ask("status")["leases"]
            if lease["consumer"] == consumer
        ),
        None,
    )


def sent_away(box, arbiter):
    """A detector on standby, and the policy that it left for, resident and idle."""
    detector = box.start("detector", *DETECTOR, footprint=BOTH)
    policy = box.start("policy", "--min-residency-s", "0", footprint=BOTH)
    assert detector.detect()["ok"]
    assert policy.detect()["ok"]
    until(lambda: state(arbiter, "detector") == "standby")
    return detector, policy


def test_it_returns_when_its_evictor_has_gone(box, arbiter):
    detector, policy = sent_away(box, arbiter)
    identity = detector.ask("ping")
    assert (identity["state"], identity["standby"], identity["token"]) == ("unloaded", True, None)
    policy.ask("unload")
    until(lambda: detector.state() == "resident")
    identity = detector.ask("ping")
    assert "standby" not in identity
    assert identity["token"] is not None
    assert state(arbiter, "detector") == "held"
    assert detector.detect(token=identity["token"])["answer"] == "red cube"
    assert "back from standby: loading" in detector.log


def test_a_request_calls_it_back_as_a_waiter_like_any_other(box, arbiter):
    detector, policy = sent_away(box, arbiter)
    first = detector.detect("red cube")
    assert (first["ok"], policy.state()) == (True, "unloaded")
    assert policy.detect()["ok"]
    until(lambda: state(arbiter, "detector") == "standby")
    assert detector.ask("unload")["ok"], "whoever tells it to unload does not want it back"
    until(lambda: state(arbiter, "detector") is None)
    assert policy.state() == "resident"


def test_a_request_whose_time_ends_does_not_end_the_standby(box, arbiter):
    detector, policy = sent_away(box, arbiter)
    running = policy.hold()
    late = detector.ask("load", timeout_s=0.2)
    assert (late["ok"], late["code"]) == (False, "wait_timeout")
    assert "vramctl why detector" in late["hint"]
    assert detector.ask("ping")["wanted"], "it was wanted, and is on its way"
    assert state(arbiter, "policy") in ("held", "revoking"), (
        "nobody is made to leave in the middle of a step"
    )
    policy.let_go()
    assert policy.client.reply(running, PATIENCE_S)["ok"]
    until(lambda: detector.state() == "resident")


def test_a_load_that_fails_on_the_way_back_leaves_nothing_behind(box, arbiter):
    detector, policy = sent_away(box, arbiter)
    switch = detector.folder / "fail_load"
    switch.touch()
    policy.ask("unload")
    until(lambda: "fails as told" in detector.ask("ping").get("last_error", ""))
    until(lambda: state(arbiter, "detector") is None)
    until(lambda: box.used() == 0)
    switch.unlink()
    assert detector.detect()["ok"]


def test_its_process_ends_in_order_while_it_is_away(box, arbiter):
    detector, _ = sent_away(box, arbiter)
    assert detector.terminate() == 0
    until(lambda: state(arbiter, "detector") is None)


def test_the_arbiter_may_be_killed_while_it_is_away(box, arbiter_daemon, arbiter):
    detector, policy = sent_away(box, arbiter)
    arbiter_daemon.kill()
    arbiter_daemon.start()
    with WireClient(arbiter_daemon.endpoint) as again:
        again.hello("looker")
        until(lambda: state(again, "detector") == "standby" and state(again, "policy") == "held")
        policy.ask("unload")
        until(lambda: detector.state() == "resident")


def test_it_comes_back_by_itself_although_the_arbiter_was_away_when_it_left(
    box, arbiter_daemon, arbiter
):
    """Regression: its release was said for 5 s; after a longer absence the lease was over here, and
    kept its room there for its ttl."""
    detector = box.start("detector", *DETECTOR, footprint=BOTH)
    policy = box.start("policy", "--min-residency-s", "0", footprint=BOTH)
    left = detector.ask("load")["lease_id"]
    os.kill(detector.model_pid(), signal.SIGSTOP)  # its end takes until it is killed
    waiting = policy.send_detect()
    until(lambda: state(arbiter, "detector") == "unloading")
    arbiter_daemon.kill()
    until(lambda: "did not hear the release" in detector.log)
    assert detector.ask("ping")["standby"]
    arbiter_daemon.start()
    assert policy.client.reply(waiting, PATIENCE_S)["ok"]
    policy.ask("unload")
    until(lambda: detector.state() == "resident")
    assert detector.ask("ping")["lease_id"] == left


def test_a_model_that_a_goal_uses_is_not_idle(box, arbiter):
    """Regression: an idle policy was let go of in the middle of a goal whose arm was still on its
    way to the start pose."""
    policy = box.start("policy", "--idle-release-s", "0.1", "--log-level", "debug", footprint=BOTH)
    held = policy.ask("load")
    goal = {"lease_id": held["lease_id"], "token": held["token"], "use_id": "goal-1"}
    assert arbiter.ask("use_begin", **goal)["ok"]
    until(lambda: policy.log.count("in use by another process: not idle") >= 3)
    assert policy.state() == "resident"
    arbiter.ask("use_end", **goal)
    until(lambda: policy.state() == "unloaded")


def test_standby_and_idle_release_contradict_each_other(box):
    sidecar = box.spawn("detector", "--standby", "--idle-release-s", "1")
    assert sidecar.process.wait(PATIENCE_S) == 2
    assert "choose one" in sidecar.log


def test_told_to_unload_while_it_waits_it_waits_no_longer(box, arbiter):
    """Regression: it waited on, and made others leave for a model that nobody wanted any more."""
    policy = box.start("policy", footprint=BOTH)
    running = policy.hold()
    detector = box.start("detector", *DETECTOR, footprint=BOTH)
    waiting = detector.send_detect()
    until(lambda: state(arbiter, "detector") == "queued")
    with WireClient(f"ipc://{box.runtime}/detector.sock") as other:
        assert other.reply(other.send("unload"), PATIENCE_S)["ok"]
    refused = detector.client.reply(waiting, PATIENCE_S)
    assert (refused["ok"], refused["code"]) == (False, "not_resident")
    until(lambda: state(arbiter, "detector") is None)
    policy.let_go()
    assert policy.client.reply(running, PATIENCE_S)["ok"]
    assert detector.detect()["ok"], "the next request asks anew"


def test_told_to_unload_while_it_is_called_back_it_is_called_back_no_longer(box, arbiter):
    """Regression: it did not say that somebody waits for it, so a runner whose goal was canceled
    did not take its load back."""
    detector, policy = sent_away(box, arbiter)
    assert "wanted" not in detector.ask("ping"), "coming back by itself it is wanted by nobody"
    running = policy.hold()
    waiting = detector.send_detect()
    until(lambda: state(arbiter, "detector") == "queued")
    with WireClient(f"ipc://{box.runtime}/detector.sock") as other:
        identity = other.reply(other.send("ping"), PATIENCE_S)
        assert (identity["state"], identity["standby"], identity["wanted"]) == (
            "unloaded",
            True,
            True,
        )
        assert other.reply(other.send("unload"), PATIENCE_S)["ok"]
    refused = detector.client.reply(waiting, PATIENCE_S)
    assert (refused["ok"], refused["code"]) == (False, "not_resident")
    assert "wanted" not in detector.ask("ping")
    until(lambda: state(arbiter, "detector") is None)
    policy.let_go()
    assert policy.client.reply(running, PATIENCE_S)["ok"]


def test_told_to_unload_while_it_loads_it_takes_the_load_back(box, arbiter):
    (box.runtime / "detector-model").mkdir()
    switch = box.runtime / "detector-model" / "slow_load"
    switch.touch()
    detector = box.start("detector", footprint=BOTH)
    waiting = detector.send_detect()
    until(lambda: state(arbiter, "detector") == "loading")
    with WireClient(f"ipc://{box.runtime}/detector.sock") as other:
        unloading = other.send("unload")
        assert other.reply(other.send("ping"), PATIENCE_S)["ok"], "it was heard behind the unload"
        switch.unlink()
        assert other.reply(unloading, PATIENCE_S)["ok"]
    refused = detector.client.reply(waiting, PATIENCE_S)
    assert (refused["ok"], refused["code"]) == (False, "not_resident")
    until(lambda: state(arbiter, "detector") is None)
    until(lambda: box.used() == 0)
    assert "ERROR" not in detector.log
    assert detector.detect()["ok"]


def test_a_load_that_is_taken_back_while_the_arbiter_is_told_of_it_is_not_resident(
    box, arbiter_daemon, arbiter
):
    """Regression: `ready` was answered behind the unload, and the sidecar said `resident`, with a
    token, of a model that was gone."""
    (box.runtime / "detector-model").mkdir()
    switch = box.runtime / "detector-model" / "slow_load"
    switch.touch()
    detector = box.start("detector", footprint="1GB,1GB,100MB")
    waiting = detector.send_detect()
    until(lambda: state(arbiter, "detector") == "loading")
    os.kill(arbiter_daemon.pid, signal.SIGSTOP)
    try:
        switch.unlink()
        until(lambda: box.used() == 1_000_000_000)
        with WireClient(f"ipc://{box.runtime}/detector.sock") as other:
            until(lambda: other.reply(other.send("ping"), PATIENCE_S)["state"] == "loading")
            unloading = other.send("unload")
            until(lambda: "unloaded in" in detector.log)
            os.kill(arbiter_daemon.pid, signal.SIGCONT)
            assert other.reply(unloading, PATIENCE_S)["ok"]
    finally:
        os.kill(arbiter_daemon.pid, signal.SIGCONT)
    refused = detector.client.reply(waiting, PATIENCE_S)
    assert (refused["ok"], refused.get("code")) == (False, "not_resident")
    identity = detector.ask("ping")
    assert (identity["state"], identity["token"]) == ("unloaded", None)
    until(lambda: state(arbiter, "detector") is None)
    assert detector.detect()["ok"]
