"""One sidecar's life, in real processes: on demand, under a token, evicted, out of memory,
ended."""

import json
import os
import signal
from pathlib import Path
from time import monotonic

import pytest

from tests.support.processes import children, server_of_imports
from tests.support.waiting import PATIENCE_S, until

pytestmark = pytest.mark.e2e

GB = 10**9
MB = 10**6


def leases(arbiter):
    return {lease["consumer"]: lease for lease in arbiter.ask("status")["leases"]}


def test_it_loads_on_the_first_request_and_not_before(box, arbiter):
    sidecar = box.start("detector")
    identity = sidecar.ask("ping")
    assert (identity["state"], identity["kind"], identity["rskill"]) == (
        "unloaded",
        "detector",
        "test/detector",
    )
    assert (identity["pid"], identity["token"], identity["model"]) == (
        sidecar.process.pid,
        None,
        "test/detector",
    )
    assert leases(arbiter) == {}
    assert sidecar.detect("red cube")["answer"] == "red cube"
    identity = sidecar.ask("ping")
    assert identity["state"] == "resident"
    lease = leases(arbiter)["detector"]
    assert (lease["state"], lease["lease_id"], lease["token"]) == (
        "held",
        identity["lease_id"],
        identity["token"],
    )
    assert (lease["charge_bytes"], box.used(), lease["pid"]) == (GB, GB, sidecar.process.pid)
    assert sidecar.ask("load") == {
        "ok": True, "lease_id": lease["lease_id"], "token": lease["token"], "loaded": False,
        "re": sidecar.client._id
    }  # fmt: skip


def test_a_callers_use_on_the_lease_keeps_the_model_until_it_ends(box, arbiter):
    policy = box.start("policy", "--min-residency-s", "0", footprint="5GB,5GB,100MB")
    other = box.start("other", footprint="5GB,5GB,100MB")
    held = policy.ask("load")
    goal = {"lease_id": held["lease_id"], "token": held["token"], "use_id": "goal-1"}
    assert arbiter.ask("use_begin", **goal)["ok"]
    waiting = other.send_detect()
    until(lambda: leases(arbiter)["policy"]["state"] == "revoking")
    for _ in range(3):
        assert policy.detect("step", token=held["token"])["ok"], (
            "the goal goes on while its holder is asked to leave"
        )
    arbiter.ask("use_end", **goal)
    assert other.client.reply(waiting, PATIENCE_S)["ok"]
    assert policy.detect("step", token=held["token"])["code"] == "evicted"


def test_a_failing_model_is_an_answer_and_the_sidecar_goes_on(box):
    sidecar = box.start("detector")
    failed = sidecar.detect("fail")
    assert (failed["ok"], failed["code"]) == (False, "model_error")
    assert failed["error"] == "ModelError: RuntimeError: the model fails as told"
    assert sidecar.detect("refuse")["code"] == "bad_request"
    assert sidecar.detect()["ok"]


@pytest.mark.parametrize("step", ["prepare", "load"])
def test_a_failed_start_takes_everything_back_and_can_be_tried_again(box, arbiter, step):
    (box.runtime / "detector-model").mkdir()
    switch = box.runtime / "detector-model" / f"fail_{step}"
    switch.touch()
    sidecar = box.start("detector")
    failed = sidecar.detect()
    assert (failed["code"], failed["error"]) == (
        "model_error",
        f"ModelError: RuntimeError: {step} fails as told",
    )
    until(lambda: leases(arbiter) == {})
    assert "fails as told" in sidecar.ask("ping")["last_error"]
    switch.unlink()
    assert sidecar.detect()["ok"]
    assert "last_error" not in sidecar.ask("ping")


def test_a_load_that_can_not_even_be_taken_back_keeps_no_lease(box, arbiter):
    """Regression: after a fault of the GPU emptying its caches fails too, and the lease was
    renewed for ever for a load that no request ended."""
    (box.runtime / "detector-model").mkdir()
    switches = [box.runtime / "detector-model" / f"fail_{step}" for step in ("load", "unload")]
    for switch in switches:
        switch.touch()
    sidecar = box.start("detector")
    assert sidecar.detect()["code"] == "model_error"
    until(lambda: leases(arbiter) == {})
    for switch in switches:
        switch.unlink()
    assert sidecar.detect()["ok"]


def test_an_out_of_memory_while_loading_rolls_back_and_is_reported(box, arbiter):
    (box.runtime / "detector-model").mkdir()
    (box.runtime / "detector-model" / "slow_load").touch()
    sidecar = box.start("detector", footprint="4GB,4GB,100MB")
    request = sidecar.send_detect()
    until(lambda: box.used() == 100 * MB)  # granted, and its context is there
    stowaway = {"pid": os.getpid(), "name": "browser", "allocated_bytes": 6 * GB}
    replace(box.gpu_folder / "browser.json", json.dumps(stowaway))
    (box.runtime / "detector-model" / "slow_load").unlink()
    failed = sidecar.client.reply(request, PATIENCE_S)
    assert failed["code"] == "oom"
    assert failed["error"].startswith(
        "OutOfMemory: CUDA out of memory (simulated). Tried to allocate"
    )
    assert failed["details"]["capacity_bytes"] == 8 * 2**30
    assert sidecar.state() == "unloaded"
    assert "oom" in {event["kind"] for event in arbiter.ask("history")["events"]}
    (box.gpu_folder / "browser.json").unlink()
    assert sidecar.detect()["ok"]


def test_the_end_of_the_process_waits_for_the_op_and_gives_everything_back(box, arbiter):
    sidecar = box.start("detector")
    running = sidecar.hold()
    sidecar.process.terminate()
    until(lambda: sidecar.state() == "unloading")
    refused = sidecar.detect()
    assert refused["code"] == "sidecar_unavailable", "nothing is loaded by a process that ends"
    sidecar.let_go()
    assert sidecar.client.reply(running, PATIENCE_S)["ok"]
    assert sidecar.process.wait(PATIENCE_S) == 0
    until(lambda: leases(arbiter) == {})
    until(lambda: box.used() == 0)


def test_the_end_does_not_wait_for_imports(box):
    (box.runtime / "detector-model").mkdir()
    (box.runtime / "detector-model" / "slow_prepare").touch()
    sidecar = box.start("detector")
    sidecar.send_detect()
    until(lambda: sidecar.state() == "waiting")
    assert sidecar.terminate() == 0


def test_shutdown_on_the_wire(box):
    sidecar = box.start("detector")
    sidecar.detect()
    assert sidecar.ask("shutdown")["ok"]
    assert sidecar.process.wait(PATIENCE_S) == 0


def test_an_idle_model_lets_go_by_itself(box, arbiter):
    sidecar = box.start("detector", "--idle-release-s", "0.3")
    sidecar.detect()
    until(lambda: sidecar.state() == "unloaded")
    until(lambda: leases(arbiter) == {})


def test_a_wait_for_the_lease_is_bounded(box):
    holder = box.start("holder", footprint="5GB,5GB,100MB")
    holder.hold()
    sidecar = box.start("detector", footprint="5GB,5GB,100MB")
    reply = sidecar.ask("load", timeout_s=0.3)
    assert (reply["ok"], reply["code"]) == (False, "wait_timeout")
    holder.let_go()


def test_imports_are_no_wait_for_the_lease(box, arbiter):
    """Regression: on a slow machine the first request of a model with large imports was denied its
    lease without the arbiter being asked."""
    (box.runtime / "detector-model").mkdir()
    switch = box.runtime / "detector-model" / "slow_prepare"
    switch.touch()
    holder = box.start("holder", footprint="5GB,5GB,100MB")
    running = holder.hold()
    sidecar = box.start("detector", footprint="5GB,5GB,100MB")
    asked = monotonic()
    waiting = sidecar.client.send("load", timeout_s=0.2)
    until(lambda: sidecar.state() == "waiting" and monotonic() > asked + 0.2)
    switch.unlink()
    denied = sidecar.client.reply(waiting, PATIENCE_S)
    assert (denied["ok"], denied["code"]) == (False, "wait_timeout")
    assert [blocker["consumer"] for blocker in denied["details"]["why"]["blockers"]] == ["holder"]
    holder.let_go()
    assert holder.client.reply(running, PATIENCE_S)["ok"]


def test_what_can_never_fit_is_said_at_once(box):
    sidecar = box.start("huge", footprint="80GB")
    assert sidecar.detect()["code"] == "vram_insufficient"


def test_the_arbiter_may_be_killed_between_two_requests(box, arbiter_daemon, arbiter):
    sidecar = box.start("detector")
    token = sidecar.ask("load")["token"]
    arbiter_daemon.kill()
    assert sidecar.state() == "resident"
    answer = sidecar.detect(token=token)
    assert answer["ok"], (answer, "a goal does not stall because the daemon is restarted")
    assert sidecar.detect()["ok"]
    arbiter_daemon.start()
    assert sidecar.detect(token=token)["ok"], "what it had it keeps"
    assert sidecar.ask("ping")["token"] == token


def replace(path, text):
    """In one step: others read the GPU meanwhile."""
    fresh = path.with_name(".new")
    fresh.write_text(text)
    fresh.rename(path)


def test_a_request_that_waits_behind_another_does_not_keep_the_lease_in_use(box, arbiter):
    """Its time is over before its work could begin: it never will, and its use ends."""
    sidecar = box.start("detector", "--wait-timeout-s", "2")
    sidecar.detect()
    held = sidecar.hold()
    assert sidecar.detect()["code"] == "wait_timeout"
    until(lambda: leases(arbiter)["detector"]["uses"] == 1)  # the one that runs
    sidecar.let_go()
    assert sidecar.client.reply(held, PATIENCE_S)["ok"]
    until(lambda: leases(arbiter)["detector"]["uses"] == 0)
    assert sidecar.detect()["ok"]


def test_a_stuck_model_is_said_and_its_process_ended(box, arbiter):
    """Regression: a request that hung in a decoder kept its lease in use for ever: no other model
    could be loaded. The memory really is in use, so only the end of the process gives it back."""
    sidecar = box.start("detector", "--request-timeout-s", "2", footprint="5GB,5GB,100MB")
    sidecar.detect()
    hanging = sidecar.hold()
    answer = sidecar.client.reply(hanging, PATIENCE_S)
    assert (answer["code"], answer["ok"]) == ("model_error", False)
    assert "has not answered within" in answer["error"]
    until(lambda: leases(arbiter) == {})
    grab = box.start("grab", footprint="5GB,5GB,100MB")
    assert grab.detect()["ok"], "the room is there for others"
    grab.ask("unload")
    assert sidecar.detect()["ok"], "the next request loads it again"


def test_a_stuck_model_does_not_keep_the_program_from_ending(box):
    sidecar = box.start("detector", "--request-timeout-s", "2")
    sidecar.detect()
    sidecar.hold()
    assert sidecar.terminate() == 0


def test_the_request_after_a_killed_model_reads_no_weights(box):
    """Regression: the weights were dropped with the model's process, so the next request read them
    again, and imported everything where their keeper had died too: 35 s under load, with a lease
    that kept other models from loading, and no line in the log."""
    sidecar = box.start("detector")
    assert sidecar.detect()["ok"]
    (sidecar.folder / "fail_read").touch()
    os.kill(sidecar.model_pid(), signal.SIGKILL)
    until(lambda: sidecar.state() == "unloaded")
    assert sidecar.detect()["ok"], "nothing was read"
    assert sidecar.log.count("prepared after") == 1


def test_after_a_killed_keeper_the_model_is_read_before_a_lease_is_asked_for(box, arbiter):
    """A lease that loads keeps other models from loading; imports and reading take the longest."""
    sidecar = box.start("detector")
    assert sidecar.detect()["ok"]
    (sidecar.folder / "slow_prepare").touch()
    (keeper,) = children(server_of_imports(sidecar.process.pid))
    os.kill(keeper, signal.SIGKILL)
    until(lambda: leases(arbiter) == {})
    until(lambda: sidecar.log.count("its libraries are imported") == 2)
    waiting = sidecar.send_detect()
    until(lambda: sidecar.ask("ping").get("wanted"))
    assert leases(arbiter) == {}
    (sidecar.folder / "slow_prepare").unlink()
    assert sidecar.client.reply(waiting, PATIENCE_S)["ok"]


def test_torch_is_not_imported_where_no_tensor_is(box):
    """The host answers `ping` and `revoke` whatever the model does, and costs no gigabyte.
    Regression: the keeper of a model without networks imported torch: 2 s of a core."""
    sidecar = box.start("detector")
    sidecar.detect()
    assert sidecar.ask("unload")["ok"]
    sidecar.detect()
    server = server_of_imports(sidecar.process.pid)
    for pid in (sidecar.process.pid, server, *children(server)):
        assert "libtorch" not in Path(f"/proc/{pid}/maps").read_text()
