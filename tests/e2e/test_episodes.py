"""Episodes: after every goal's end, however it came, the detector is back on the GPU by itself,
and never before.

Real processes: arbiter, detector on standby, policy that lets go when idle, runner with the
simulator, reasoner. Nobody sequences anything: each is a plain client. The witnesses are the
arbiter's history and the GPU's own log, which an independent checker reads.
"""

import asyncio
import json
import os
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AsyncExitStack
from typing import Any

import pytest

from tests.e2e.episode_stage import (
    BOOT_S,
    DEADLINE_S,
    GB,
    JOINTS,
    MANIFESTS,
    POLICY_BYTES,
    SKILL,
    WAIT_S,
    Programs,
    Stage,
)
from tests.runner.small_robots import robot_of
from tests.support.chat_server import chat_server
from tests.support.prepared import run
from vram_arbiter.clients.cli.replies import UNREACHABLE
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.protocols import Goal
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.errors import GoalRejected, UnknownSkill, WaitTimeout
from vram_arbiter.schemas.manifest import parse_manifest

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(295)]
CALL_BEGINS_S = (4.0, 16.0, 50.0)
"""Deadlines of a goal that ends within a call of its model: this machine may need as long to begin
that call."""


@pytest.fixture(scope="module")
def episode_programs() -> Iterator[Programs]:
    started = Programs()
    yield started
    started.close()


# -- how a goal ends
async def done(stage: Stage) -> None:
    goal = await stage.goal_under_way()
    for _ in range(20):  # an operator asks again where no answer came in time
        environ = stage.programs.arbiter.environ
        shown = await asyncio.to_thread(run, "vramctl", ["status"], environ, WAIT_S)
        if shown.returncode != UNREACHABLE:
            break
    (line,) = [line for line in shown.stdout.splitlines() if " detector " in line]
    assert " standby " in line, shown
    why = (await stage.arbiter.why("detector")).leases[0].text
    assert why == "detector: on standby until policy has left"
    assert stage.detector_was_away()
    stage.programs.tell("hold", False)
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    await stage.detector_is_back()


async def failed(stage: Stage) -> None:
    goal = await stage.goal_under_way()
    stage.programs.tell("fail", True)
    stage.programs.tell("hold", False)
    result = await goal.result(WAIT_S)
    assert (result["status"], result["code"]) == ("failed", "model_error")
    await stage.detector_is_back()


async def canceled(stage: Stage) -> None:
    goal = await stage.goal_under_way()
    await goal.cancel()
    assert (await goal.result(WAIT_S))["status"] == "canceled"
    stage.programs.tell("hold", False)
    await stage.detector_is_back()


async def rejected(stage: Stage) -> None:
    """A goal that is refused changes nothing: neither while the detector is there, nor while
    another goal has sent it away."""
    with pytest.raises(UnknownSkill):
        await stage.runner.send_goal("test/arm-nothing", prompt="x")
    assert await stage.leases() == {"detector": "held"}
    goal = await stage.goal_under_way()
    with pytest.raises(GoalRejected):
        await stage.runner.send_goal(SKILL, prompt="another one")
    assert await stage.leases() == {"policy": "held", "detector": "standby"}
    stage.programs.tell("hold", False)
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    await stage.detector_is_back()


async def past_its_deadline(stage: Stage) -> None:
    """The result is out, but a call of the model still runs: its bytes are on the GPU, so the
    detector stays away until they are measured gone."""
    async with PolicyClient(
        f"ipc://{stage.programs.runtime}/policy.sock", connect_timeout_s=BOOT_S
    ) as policy:
        for deadline_s in CALL_BEGINS_S:
            await policy.load()  # what the deadline is met by is the call alone
            if (goal := await stage.goal_caught_in_a_call(deadline_s)) is not None:
                break
    assert goal is not None, "no call began in time"
    assert (await goal.result(WAIT_S))["status"] == "deadline"
    await stage.until("use_ended", "policy")
    assert (stage.programs.runtime / "policy/holding").exists()
    assert (await stage.leases())["detector"] == "standby"
    assert stage.detector_was_away()
    (gpu,) = (await stage.arbiter.status()).gpus
    assert gpu.charged_bytes >= POLICY_BYTES
    stage.programs.tell("hold", False)
    await stage.detector_is_back()


async def policy_killed(stage: Stage) -> None:
    goal = await stage.goal_under_way()
    stage.programs.kill("policy")
    result = await goal.result(WAIT_S)
    assert (result["status"], result["code"] in ("sidecar_unavailable", "lease_lost")) == (
        "failed",
        True,
    ), result
    await stage.detector_is_back(after="lost")


async def load_failed(stage: Stage) -> None:
    """The policy never comes up: the detector was sent away for nothing, and nothing of the load
    stays behind."""
    stage.programs.tell("fail_load", True)
    goal = await stage.runner.send_goal(SKILL, prompt="hold still", deadline_s=DEADLINE_S)
    result = await goal.result(WAIT_S)
    assert (result["status"], result["code"]) == ("failed", "model_error")
    await stage.detector_is_back(after="granted")


async def out_of_memory(stage: Stage) -> None:
    """Somebody without a lease fills the GPU while the policy loads: the goal hears of it by type,
    and the detector waits for the room."""
    stage.programs.tell("slow_load", True)
    goal = await stage.runner.send_goal(SKILL, prompt="hold still", deadline_s=DEADLINE_S)
    await stage.until("granted", "policy")
    stowaway = stage.programs.arbiter.gpu_folder / "browser.json"
    fresh = stowaway.with_name(".new")
    fresh.write_text(json.dumps({"pid": os.getpid(), "name": "browser", "allocated_bytes": 6 * GB}))
    fresh.rename(stowaway)
    try:
        stage.programs.tell("slow_load", False)
        result = await goal.result(WAIT_S)
        assert (result["status"], result["code"]) == ("failed", "oom")
        await stage.until("verified", "policy")
        assert await stage.leases() == {"detector": "standby"}
        assert stage.detector_was_away()
    finally:
        stowaway.unlink()
    # whose the bytes are is contested where the stowaway came between two readings of the load
    await stage.detector_is_back(after="granted", verdicts=("verified", "residue", "contested"))


async def canceled_while_loading(stage: Stage) -> None:
    """Nobody wants the policy any more: its load is taken back, not finished for nobody."""
    stage.programs.tell("slow_load", True)
    goal = await stage.runner.send_goal(SKILL, prompt="hold still", deadline_s=DEADLINE_S)
    await stage.until("granted", "policy")
    async with PolicyClient(f"ipc://{stage.programs.runtime}/policy.sock") as policy:
        await goal.cancel()
        while (await policy.ping(timeout_s=WAIT_S))["state"] == "loading":
            await asyncio.sleep(0.01)  # until the runner has told it
    stage.programs.tell("slow_load", False)
    assert (await goal.result(WAIT_S))["status"] == "canceled"
    await stage.detector_is_back(after="granted")
    assert stage.first("ready", "policy") is None


async def reasoner_killed(stage: Stage) -> None:
    """The goal does not depend on who asked for it, and neither does the detector's return."""
    call = (f"execute_rskill__{SKILL.replace('/', '__')}", {"prompt": "hold still"})
    with chat_server(lambda asked: call) as url:
        stage.programs.tell("hold", True)
        stage.programs.start(
            "reasoner", "--task", "hold still", "--planner",
            "openai", "--detector", "none", "--scene-vlm", "none",
            VRAM_REASONER_LLM_BASE_URL=url, VRAM_REASONER_LLM_MODEL="m",
        )  # fmt: skip
        await stage.until("use_began", "policy", BOOT_S)
        await stage.holding()
        stage.programs.kill("reasoner")
    await stage.under_way()
    assert (await stage.runner.state())["phase"] == "running"
    stage.programs.tell("hold", False)
    await stage.detector_is_back()


async def runner_killed(stage: Stage) -> None:
    await stage.goal_under_way()
    stage.programs.kill("runner")
    await stage.until("use_ended", "policy")
    stage.programs.tell("hold", False)
    await stage.detector_is_back()


async def called_back(stage: Stage) -> None:
    """Of a policy that is on standby itself: its lease waits to come back, behind a look, when its
    goal is over."""
    episode_programs, manifest = stage.programs, parse_manifest(MANIFESTS["policy"])
    episode_programs.sidecar(
        "policy", POLICY_BYTES, "--standby", "--min-residency-s", "0", name="spare"
    )
    robot = robot_of(*JOINTS.strip("[]").split(", "))
    where = f"ipc://{episode_programs.runtime}/spare.sock"
    async with PolicyClient(where, connect_timeout_s=BOOT_S) as sidecar:
        skill = SidecarPolicy(
            manifest, wire_up(manifest, robot, None), sidecar, stage.arbiter, period_s=0.1
        )
        goal = Goal("g", SKILL, prompt="hold still", deadline_s=DEADLINE_S)
        await skill.start(goal)
        await skill.finish()
        looking = await stage.detector.load()
        assert await stage.leases() == {"spare": "standby", "detector": "held"}
        assert (looking["lease_id"], looking["token"]) != (None, None)
        async with stage.arbiter.use(looking["lease_id"] or "", looking["token"] or ()):
            starting = asyncio.create_task(skill.start(goal))
            while (await stage.leases())["spare"] != "queued":
                await asyncio.sleep(0.02)
            starting.cancel()
            await asyncio.wait([starting])
            assert starting.cancelled()
            while "spare" in await stage.leases():
                await asyncio.sleep(0.02)
        while (await stage.leases()).get("detector") != "held":  # it had been asked to leave
            await asyncio.sleep(0.02)
        assert (
            sum((e["kind"], e.get("consumer")) == ("granted", "spare") for e in stage.events) == 1
        )


def test_a_policy_is_called_back_from_standby_only_as_long_as_its_goal_wants_it(
    episode_programs: Programs,
) -> None:
    """Regression: the detector left the GPU for a goal that had been canceled, and stayed away."""
    try:
        assert episode_programs.play(called_back) == []
    finally:
        episode_programs.kill("spare")


# -- while it runs
async def wanted_meanwhile(stage: Stage) -> None:
    """No holder leaves in the middle of a step; the look that was wanted comes with the goal's
    end."""
    goal = await stage.goal_under_way()
    with pytest.raises(WaitTimeout):
        await stage.detector.load(timeout_s=0.2)
    assert stage.detector_was_away()
    stage.programs.tell("hold", False)
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    ready = await stage.until("ready", "detector")
    ended = await stage.until("use_ended", "policy")
    assert ended["seq"] < ready["seq"]
    assert await stage.leases() == {"detector": "held"}


async def one_after_the_other(stage: Stage) -> None:
    """The next goal, with other words, loads nothing and lets nothing back in between."""
    np = pytest.importorskip("numpy")
    stage.programs.tell("hold", True)
    async with AsyncExitStack() as stack:
        policy = await stack.enter_async_context(
            PolicyClient(f"ipc://{stage.programs.runtime}/policy.sock", connect_timeout_s=BOOT_S)
        )
        call = asyncio.create_task(policy.get_action({"observation.state": np.zeros(6)}))
        await stage.holding()
        held = await policy.ping(timeout_s=WAIT_S)
        assert held["token"] is not None
        await stack.enter_async_context(stage.arbiter.use(held["lease_id"], held["token"]))
        # from one use to the next: no moment in which it could be idle
        stage.programs.tell("hold", False)
        await call
        for prompt in ("hold still", "go on holding still"):
            goal = await stage.runner.send_goal(SKILL, prompt=prompt, deadline_s=DEADLINE_S)
            assert (await goal.result(WAIT_S))["status"] == "succeeded"
        assert await stage.leases() == {"policy": "held", "detector": "standby"}
        assert (
            sum((e["kind"], e.get("consumer")) == ("granted", "policy") for e in stage.events) == 1
        )
    await stage.detector_is_back(after="ready")


async def without_a_gpu(stage: Stage) -> None:
    """A goal without a GPU evicts no holder."""
    before = await stage.detector.ping(timeout_s=WAIT_S)
    goal = await stage.runner.send_goal(
        "vram-arbiter/so101-navigate", goal_params={"turn_rad": 0.1}
    )
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    assert await stage.leases() == {"detector": "held"}
    assert (await stage.detector.ping(timeout_s=WAIT_S))["token"] == before["token"]


async def slow_start(stage: Stage) -> None:
    """No goal runs before its policy is ready."""
    stage.programs.tell("slow_load", True)
    stage.programs.tell("hold", True)
    goal = await stage.runner.send_goal(SKILL, prompt="hold still", deadline_s=DEADLINE_S)
    await stage.until("granted", "policy")
    phases: list[str] = []
    async for feedback in goal.feedback():
        phases.append(feedback["state"])
        if feedback["state"] == "running":
            break
        if phases.count("starting") == 1:  # it may be told again behind the load's end
            assert (await stage.leases())["policy"] == "loading"
            stage.programs.tell("slow_load", False)
    assert set(phases) <= {"acquiring", "starting", "running"}
    ready, began = await stage.until("ready", "policy"), await stage.until("use_began", "policy")
    assert ready["seq"] < began["seq"]
    await stage.holding()
    await stage.under_way()
    stage.programs.tell("hold", False)
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    await stage.detector_is_back()


ENDS = (
    done, failed, canceled, rejected, past_its_deadline, load_failed, out_of_memory,
    canceled_while_loading, policy_killed, reasoner_killed, runner_killed,
)  # fmt: skip
MEANWHILE = (wanted_meanwhile, one_after_the_other, without_a_gpu, slow_start)


@pytest.mark.parametrize("scenario", [*ENDS, *MEANWHILE], ids=lambda story: story.__name__)
def test_the_detector_is_away_for_a_goal_and_back_by_itself(
    episode_programs: Programs, scenario: Callable[[Stage], Coroutine[Any, Any, None]]
) -> None:
    """After every end of a goal, and never before."""
    assert episode_programs.play(scenario) == []
