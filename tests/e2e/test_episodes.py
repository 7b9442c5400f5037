"""Episodes: after every goal's end, however it came, the detector is back on the GPU by itself,
and never before.

Real processes: arbiter, detector on standby, policy that lets go when idle, runner with the
simulator, reasoner. Nobody sequences anything: each is a plain client. The witnesses are the
arbiter's history and the GPU's own log, which an independent checker reads.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
from collections.abc import Callable, Coroutine, Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import pytest

from tests.runner.small_robots import robot_of
from tests.support.chat_server import chat_server
from tests.support.fakegpu_check import check_log
from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.cli.replies import UNREACHABLE
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import Goal as AcceptedGoal
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.protocols import Goal
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.errors import GoalRejected, UnknownSkill, WaitTimeout
from vram_arbiter.schemas.manifest import parse_manifest

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(295)]

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
WAIT_S = 60.0  # for an event; a starved machine needs some of it
BOOT_S = 180.0  # for a program's imports there
SCENARIO_S = 250.0
SKILL = "test/arm-policy"
DEADLINE_S = 120.0  # of goals that shall not meet it
CALL_BEGINS_S = (
    4.0,
    16.0,
    50.0,
)  # of the one that shall, within a call of its model: as long as this machine needs to begin that
GB = 10**9
DETECTOR_BYTES, POLICY_BYTES, CONTEXT_BYTES = 5 * GB, 4 * GB, GB // 10
JOINTS = "[shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper]"
MANIFESTS = {
    "detector": """
name: test/arm-detector
version: 0.1.0
license: mit
kind: detector
embodiment_tags: [any]
chunk_size: 1
weights_uri: hf://test/detector
description: sees nothing
latency_budget: {per_chunk_ms: 100}
actions: [detect]
detector: {labels: [cube]}
""",
    "policy": f"""
name: {SKILL}
version: 0.1.0
license: mit
kind: vla
model_family: act
embodiment_tags: [so101_follower]
sensors_required:
  - {{modality: rgb, vla_feature_key: observation.images.front}}
actuators_required:
  - {{kind: joint_position, control_mode_semantics: {{mode: absolute, joint_order: {JOINTS}}}}}
weights_uri: hf://test/policy
chunk_size: 10
latency_budget: {{per_chunk_ms: 6000, max_execution_s: 5}}
description: holds the arm still
actions: [grasp]
action_contract: {{dim: 6}}
policy_extras: {{rollout_steps: 12, stop_when_still: false}}
""",
}


class Programs:
    """The processes of one robot; those that a test killed are started again by `up`. `tell` makes
    the policy's model behave."""

    def __init__(self) -> None:
        self.arbiter = ArbiterProcess(prepared=True).start()
        self.runtime = self.arbiter.runtime
        self.running: dict[str, Forked] = {}
        for name, manifest in MANIFESTS.items():
            (self.runtime / name).mkdir()
            (self.runtime / name / "rskill.yaml").write_text(manifest)

    def up(self) -> None:
        for flag in ("hold", "holding", "fail", "fail_load", "slow_load"):
            self.tell(flag, False)
        self.sidecar("detector", DETECTOR_BYTES, "--standby", "--min-residency-s", "0")
        self.sidecar("policy", POLICY_BYTES, "--idle-release-s", "0.2", "--min-residency-s", "1")
        skills = [str(self.runtime / "policy"), str(ROOT / "configs/rskills/so101-navigate")]
        self.start("runner", "sim", "--skills", *skills, "--seed", "1")

    def sidecar(self, model: str, size: int, *flags: str, name: str = "") -> None:
        name, folder = name or model, self.runtime / model
        if not self.runs(name):
            arguments = [
                str(folder), "--name", name, "--rskill", f"{folder}/rskill.yaml",
                "--device", f"fake:{self.arbiter.gpu_folder}",
                "--footprint", f"{size},{size},{CONTEXT_BYTES}", *flags,
            ]  # fmt: skip
            with (self.runtime / "programs.log").open("ab") as log:
                self.running[name] = start(
                    "episode", arguments, self.arbiter.environ, log.fileno(), log.fileno()
                )

    def runs(self, name: str) -> bool:
        return name in self.running and self.running[name].poll() is None

    def start(self, name: str, *words: str, **environ: str) -> None:
        if self.runs(name):
            return
        environ = self.arbiter.environ | environ
        with (self.runtime / "programs.log").open("ab") as log:
            self.running[name] = start(
                f"vram-{name}", words, environ, log.fileno(), log.fileno(), cwd=ROOT
            )

    def tell(self, flag: str, on: bool) -> None:
        path = self.runtime / "policy" / flag
        path.touch() if on else path.unlink(missing_ok=True)

    def kill(self, name: str) -> None:
        os.kill(self.running[name].pid, signal.SIGKILL)
        self.running[name].wait(WAIT_S)

    def play(self, scenario: "Callable[[Stage], Coroutine[Any, Any, None]]") -> list[str]:
        """Run it on a stage of its own; a failure shows what the programs said.

        Returns what was wrong on the simulated GPU until its end.
        """

        async def bounded() -> None:
            async with asyncio.timeout(SCENARIO_S), AsyncExitStack() as stack:
                await scenario(await Stage.open(self, stack))

        self.up()
        try:
            asyncio.run(bounded())
        except BaseException:
            print((self.runtime / "programs.log").read_text(errors="replace")[-6000:])
            raise
        return self.wrong_on_the_gpu()

    def wrong_on_the_gpu(self) -> list[str]:
        return check_log((self.arbiter.gpu_folder / "log.jsonl").read_text()).problems

    def close(self) -> None:
        for process in reversed(self.running.values()):
            if process.poll() is None:
                process.terminate()
        for process in self.running.values():
            try:
                process.wait(20)
            except subprocess.TimeoutExpired:
                process.kill()
                process.wait(WAIT_S)
        wrong = self.wrong_on_the_gpu()
        self.arbiter.close()
        assert wrong == []


class Stage:
    """One test's clients, and the history from its beginning on. It opens with the detector on the
    GPU and nobody else."""

    def __init__(self, episode_programs: Programs) -> None:
        self.programs = episode_programs
        self.events: list[dict[str, Any]] = []
        self._more = asyncio.Event()
        self.arbiter: AsyncClient
        self.runner: RunnerClient
        self.detector: DetectorClient

    @classmethod
    async def open(cls, episode_programs: Programs, stack: AsyncExitStack) -> "Stage":
        stage, where = cls(episode_programs), f"ipc://{episode_programs.runtime}"
        stage.arbiter = await stack.enter_async_context(
            AsyncClient(
                "witness",
                endpoint=episode_programs.arbiter.endpoint,
                role="operator",
                connect_timeout_s=WAIT_S,
            )
        )
        stage.runner = await stack.enter_async_context(
            RunnerClient(f"{where}/runner.sock", connect_timeout_s=BOOT_S)
        )
        stage.detector = await stack.enter_async_context(
            DetectorClient(f"{where}/detector.sock", connect_timeout_s=BOOT_S)
        )
        await stage.runner.ping(timeout_s=BOOT_S)
        await stage.detector.load()
        while "policy" in await stage.leases():  # of the test before
            await asyncio.sleep(0.02)
        listening = asyncio.create_task(stage._listen())
        stack.callback(listening.cancel)
        while (
            not stage.events
        ):  # subscribed: a use of nobody's is refused, a ping is not told; a look is
            await stage.detector.detect(b"\x89PNG\r\n\x1a\n", "cube")
            await asyncio.sleep(0.02)
        stage.events.clear()
        return stage

    async def _listen(self) -> None:
        async for event in self.arbiter.subscribe():
            self.events.append(event)
            self._more.set()

    async def until(self, kind: str, consumer: str, timeout_s: float = WAIT_S) -> dict[str, Any]:
        """The first such event of this test, waited for if need be."""
        async with asyncio.timeout(timeout_s):
            while (found := self.first(kind, consumer)) is None:
                self._more.clear()
                await self._more.wait()
        return found

    def first(self, kind: str, consumer: str) -> dict[str, Any] | None:
        return next(
            (e for e in self.events if (e["kind"], e.get("consumer")) == (kind, consumer)), None
        )

    async def under_way(self) -> None:
        """A goal has its policy in use and the detector is away. What was before its policy's last
        load is forgotten: on a slow machine the policy may have been idle, and gone, between a load
        and the use that it was for.
        """
        assert await self.leases() == {"policy": "held", "detector": "standby"}
        loads = [
            n
            for n, e in enumerate(self.events)
            if (e["kind"], e.get("consumer")) == ("ready", "policy")
        ]
        del self.events[: loads[-1]]

    async def leases(self) -> dict[str, str]:
        return {view.consumer: view.state for view in (await self.arbiter.status()).leases}

    async def goal_under_way(self) -> AcceptedGoal:
        """A goal that has its policy resident and in use, held inside a call of the model, and the
        detector away."""
        self.programs.tell("hold", True)
        goal = await self.runner.send_goal(SKILL, prompt="hold still", deadline_s=DEADLINE_S)
        await self.until("use_began", "policy", BOOT_S)
        await self.holding()
        await self.under_way()
        return goal

    async def goal_caught_in_a_call(self, deadline_s: float) -> AcceptedGoal | None:
        """A goal whose call of the model, `held`, has begun within its time; None if it has not."""
        self.programs.tell("hold", True)
        goal = await self.runner.send_goal(SKILL, prompt="hold still", deadline_s=deadline_s)
        began, ended = asyncio.create_task(self.holding()), asyncio.create_task(goal.result())
        await asyncio.wait({began, ended}, return_when=asyncio.FIRST_COMPLETED)
        began.cancel()
        ended.cancel()
        if not ended.done() or (self.programs.runtime / "policy/holding").exists():
            await self.under_way()
            return goal
        self.programs.tell("hold", False)
        return None

    async def holding(self) -> None:
        async with asyncio.timeout(WAIT_S):
            while not (self.programs.runtime / "policy/holding").exists():
                await asyncio.sleep(0.01)

    async def detector_is_back(
        self, *, after: str = "use_ended", verdicts: tuple[str, ...] = ("verified", "residue")
    ) -> None:
        """By itself, once: granted after the policy's `after` and after its bytes were measured
        gone, and loaded."""
        ended = await self.until(after, "policy")
        gone = await self.until("verified", "policy")
        granted = await self.until("granted", "detector")
        ready = await self.until("ready", "detector")
        assert ended["seq"] < gone["seq"] < granted["seq"] < ready["seq"], self.events
        assert gone["verdict"] in verdicts, gone
        assert granted["reason"] == "back from standby: there is room and nothing waits"
        assert (
            sum(e["kind"] == "granted" and e.get("consumer") == "detector" for e in self.events)
            == 1
        )
        await self.detector.load()  # the arbiter's word is a moment ahead of the sidecar's
        (shown,) = (await self.arbiter.status()).leases
        assert shown.token is not None
        token = [shown.token.epoch, shown.token.serial]
        assert (await self.detector.ping(timeout_s=WAIT_S))["token"] == token
        assert await self.leases() == {"detector": "held"}

    def detector_was_away(self) -> bool:
        return self.first("granted", "detector") is None


@pytest.fixture(scope="module")
def episode_programs() -> Iterator[Programs]:
    started = Programs()
    yield started
    started.close()


# -- how a goal ends
async def done(stage: Stage) -> None:
    goal = await stage.goal_under_way()
    for _ in range(
        20
    ):  # an operator asks again where nobody answered in the seconds that he is made to wait
        shown = await asyncio.create_subprocess_exec(
            sys.executable, "-m", "vram_arbiter.clients", "status",
            env=stage.programs.arbiter.environ, stdout=asyncio.subprocess.PIPE
        )  # fmt: skip
        said = (await shown.communicate())[0].decode()
        if shown.returncode != UNREACHABLE:
            break
    (line,) = [line for line in said.splitlines() if " detector " in line]
    assert " standby " in line, said
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


@pytest.mark.parametrize(
    "end",
    [done, failed, canceled, rejected, past_its_deadline, load_failed, out_of_memory,
    canceled_while_loading, policy_killed, reasoner_killed,
     runner_killed],
    ids=lambda end: end.__name__,
)  # fmt: skip
def test_after_a_goal_the_detector_is_back_by_itself(
    episode_programs: Programs, end: Callable[[Stage], Coroutine[Any, Any, None]]
) -> None:
    assert episode_programs.play(end) == []


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


def test_who_wants_to_look_in_the_middle_of_a_goal_is_told_to_wait(
    episode_programs: Programs,
) -> None:
    """Nobody is made to leave in the middle of a step; the look that was wanted comes with the
    goal's end."""
    assert episode_programs.play(wanted_meanwhile) == []


async def one_after_the_other(stage: Stage) -> None:
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
        stage.programs.tell(
            "hold", False
        )  # from one use to the next: no moment in which it could be idle
        await call
        for prompt in ("hold still", "go on holding still"):
            goal = await stage.runner.send_goal(SKILL, prompt=prompt, deadline_s=DEADLINE_S)
            assert (await goal.result(WAIT_S))["status"] == "succeeded"
        assert await stage.leases() == {"policy": "held", "detector": "standby"}
        assert (
            sum((e["kind"], e.get("consumer")) == ("granted", "policy") for e in stage.events) == 1
        )
    await stage.detector_is_back(after="ready")


def test_the_next_goal_with_other_words_loads_nothing_and_lets_nothing_back_in_between(
    episode_programs: Programs,
) -> None:
    assert episode_programs.play(one_after_the_other) == []


async def without_a_gpu(stage: Stage) -> None:
    before = await stage.detector.ping(timeout_s=WAIT_S)
    goal = await stage.runner.send_goal(
        "vram-arbiter/so101-navigate", goal_params={"turn_rad": 0.1}
    )
    assert (await goal.result(WAIT_S))["status"] == "succeeded"
    assert await stage.leases() == {"detector": "held"}
    assert (await stage.detector.ping(timeout_s=WAIT_S))["token"] == before["token"]


def test_a_goal_without_a_gpu_sends_nobody_away(episode_programs: Programs) -> None:
    assert episode_programs.play(without_a_gpu) == []


async def slow_start(stage: Stage) -> None:
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


def test_no_goal_runs_before_its_policy_is_ready(episode_programs: Programs) -> None:
    assert episode_programs.play(slow_start) == []
