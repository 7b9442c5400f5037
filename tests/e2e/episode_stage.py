"""The programs of one robot, and the stage of one test with its clients and the history."""

import asyncio
import os
import signal
import subprocess
from collections.abc import Callable, Coroutine
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

from tests.sidecars.conftest import MANIFEST
from tests.support.fakegpu_check import check_log
from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from tests.support.waiting import eventually
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import Goal as AcceptedGoal
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient

HERE = Path(__file__).parent
ROOT = HERE.parents[1]
WAIT_S = 60.0  # for an event; a starved machine needs some of it
BOOT_S = 180.0  # for a program's imports there
SCENARIO_S = 250.0
SKILL = "test/arm-policy"
DEADLINE_S = 120.0  # of goals that shall not meet it
GB = 10**9
DETECTOR_BYTES, POLICY_BYTES, CONTEXT_BYTES = 5 * GB, 4 * GB, GB // 10
JOINTS = "[shoulder_pan, shoulder_lift, elbow_flex, wrist_flex, wrist_roll, gripper]"
MANIFESTS = {
    "detector": MANIFEST.format(name="arm-detector"),
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
        # subscribed once a detection is told; a ping is not
        while not stage.events:
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
        await eventually((self.programs.runtime / "policy/holding").exists)

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
        token = [shown.token.epoch, shown.token.serial]
        assert (await self.detector.ping(timeout_s=WAIT_S))["token"] == token
        assert await self.leases() == {"detector": "held"}

    def detector_was_away(self) -> bool:
        return self.first("granted", "detector") is None
