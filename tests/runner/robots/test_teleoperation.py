"""lerobot's own leader arm, byte for byte over a serial port, moves the twin with physics: through
the gate, under the control loop, as a goal and in the middle of another one.
"""

import asyncio
import itertools
import math
import os
from collections.abc import AsyncIterator
from contextlib import AsyncExitStack
from dataclasses import dataclass, field
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.runner.skills.policy_bench import Arbiter, Sidecar
from tests.runner.small_robots import FedCamera, hardware_runner
from tests.support.waiting import PATIENCE_S, eventually, until
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.runner.__main__ import parse
from vram_arbiter.runner.cli.deployment import DeploymentFile, Parts, make_parts
from vram_arbiter.runner.cli.makers import operator_of
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.goals.server import GoalServer
from vram_arbiter.runner.protocols import Goal, GoalTick, SkillEnded
from vram_arbiter.runner.recording.recorder import DatasetRecorder
from vram_arbiter.runner.robots.hardware import HardwareRunner
from vram_arbiter.runner.robots.so101 import RANGES_RAD, so101
from vram_arbiter.runner.robots.teleoperators import Keyboard, make_teleoperator
from vram_arbiter.runner.skills.ros_standins import StandIns
from vram_arbiter.runner.skills.sidecar_policy import SidecarPolicy
from vram_arbiter.runner.skills.teleop import ALIGN_RAD_S, MANIFEST, NAME
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.config.robot import TeleopConfig, robot_of
from vram_arbiter.schemas.errors import BadState, ConfigError, RobotFault
from vram_arbiter.schemas.manifest import Kind, parse_manifest
from vram_arbiter.schemas.yamltext import parse_yaml

from .servo_bus import PRESENT, ServoBus

pytestmark = [pytest.mark.heavy, pytest.mark.anyio, pytest.mark.timeout(300)]

RATE_HZ = 30.0
COUNTS_PER_RAD = 4095 / (2 * math.pi)
JOINTS = tuple(RANGES_RAD)
FILE = """
robot_id: bench
hal: {{adapter: so101_mujoco}}
teleop: {{adapter: "lerobot:so101_leader", transport: {transport}}}
"""
GRAB = """
name: "test/grab"
version: "1.0.0"
kind: vla
model_family: act
embodiment_tags: [any]
sensors_required: [{modality: rgb, vla_feature_key: observation.images.front}]
actuators_required:
  - {kind: joint_position, n_dof: 6, vla_action_key: action,
     control_mode_semantics: {mode: absolute}}
weights_uri: "local://models/none"
chunk_size: 3
latency_budget: {per_chunk_ms: 100.0, max_execution_s: 20.0}
min_vram_gb: {fp32: 1.0}
description: "A policy of this test."
actions: [grasp]
action_contract: {dim: 6}
policy_extras: {rollout_steps: 100000, stop_when_still: false}
"""


@dataclass
class Ticks:
    """What a recorder is told."""

    ticks: list[GoalTick] = field(default_factory=list)

    def tick(self, tick: GoalTick) -> None:
        self.ticks.append(tick)

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        pass

    def facts(self) -> dict[str, Any]:
        return {}

    def longest_step(self, since: int = 0) -> float:
        """Of any joint's target within a tick, rad."""
        targets = [tick.targets for tick in self.ticks[since:]]
        return max(
            abs(after[name] - before[name])
            for before, after in itertools.pairwise(targets)
            for name in before
        )


@dataclass
class Bench:
    bus: ServoBus
    parts: Parts
    runner: HardwareRunner
    client: RunnerClient
    ticks: Ticks
    sidecar: Sidecar
    arbiter: Arbiter

    def lead(self, name: str, angle_rad: float) -> None:
        """Move a joint of the leader."""
        counts = 2047 + round(angle_rad * COUNTS_PER_RAD)
        self.bus.put(JOINTS.index(name) + 1, PRESENT, counts)

    def lead_to_rest(self) -> None:
        rest = self.parts.hal.description.rest_pose_rad
        for name in JOINTS[:5]:
            self.lead(name, rest[name])
        low, high = RANGES_RAD["gripper"]
        self.bus.put(6, PRESENT, round(4095 * (rest["gripper"] - low) / (high - low)))

    async def until_at(self, name: str, angle_rad: float) -> None:
        await eventually(lambda: abs(self.parts.hal.sent().get(name, 9.0) - angle_rad) <= 0.01)

    async def until_asked(self, times: int) -> None:
        """Until the policy was."""
        await eventually(lambda: len(self.sidecar.observations) >= times)

    async def five_ticks_more(self) -> None:
        wanted = len(self.ticks.ticks) + 5
        await eventually(lambda: len(self.ticks.ticks) >= wanted)

    async def until_phase(self, phase: str) -> None:
        async with asyncio.timeout(PATIENCE_S):
            while (await self.client.state())["phase"] != phase:
                await asyncio.sleep(0.01)


def parts_of(bus: ServoBus, folder: Path, **transport: Any) -> Parts:
    given = {"port": bus.path, "id": "arm", "calibration_dir": str(folder), **transport}
    source = parse_yaml(FILE.format(transport=given), "robot.yaml")
    return make_parts(DeploymentFile(robot_of(source), source), SystemClock())


@pytest.fixture
async def rig(bus: ServoBus, calibrated: Path, tmp_path: Path) -> AsyncIterator[Bench]:
    async with AsyncExitStack() as stack:
        yield await bench_of(stack, bus, calibrated, tmp_path)


async def bench_of(
    stack: AsyncExitStack, bus: ServoBus, calibrated: Path, folder: Path, *sinks: Any
) -> Bench:
    clock = SystemClock()
    parts = parts_of(bus, calibrated, num_read_retries=20)
    runner = hardware_runner(
        parts.hal,
        [(FedCamera("front", clock), 60_000.0)],
        lambda skill: parts.gate.for_skill(skill.manifest, skill.cameras),
        rate_hz=RATE_HZ,
        clock=clock,
    )
    ticks, sidecar, arbiter = Ticks(), Sidecar(), Arbiter()
    for sink in (ticks, *sinks):
        runner.follow(sink)
    grab, robot = parse_manifest(GRAB), parts.hal.description
    await stack.enter_async_context(sidecar.served(f"ipc://{folder}/grab.sock"))

    def policy(manifest: Any) -> SidecarPolicy:
        return SidecarPolicy(
            manifest,
            wire_up(manifest, robot, robot.rest_pose_rad),
            PolicyClient(f"ipc://{folder}/grab.sock", timeout_s=60.0),
            arbiter,  # type: ignore[arg-type]
            period_s=1 / RATE_HZ,
            speeds_rad_s=parts.gate.limits.speeds_rad_s,
            sent=parts.hal.sent,
        )

    makers = {
        Kind.VLA: policy,
        Kind.ROS_ACTION: StandIns(operator_of(parts, 1 / RATE_HZ), JOINTS),
    }
    control = await stack.enter_async_context(ControlThread(runner))
    endpoint = f"ipc://{folder}/runner.sock"
    mark = sinks[0].mark if sinks else None
    server = GoalServer(
        endpoint, control, Catalogue([grab, MANIFEST], makers), clock, mark=mark, estop_s=60.0
    )
    serving = asyncio.create_task(server.serve())
    await server.bound.wait()

    async def end() -> None:
        server.stopping.set()
        await serving

    stack.push_async_callback(end)
    client = await stack.enter_async_context(RunnerClient(endpoint))
    made = Bench(bus, parts, runner, client, ticks, sidecar, arbiter)
    rest = [robot.rest_pose_rad[name] for name in JOINTS]
    sidecar.action = [rest] * 3
    made.lead_to_rest()
    return made


async def test_the_arm_goes_to_the_leader_without_a_jump_and_then_follows_it(rig: Bench) -> None:
    rig.lead("shoulder_pan", 0.3)
    goal = await rig.client.send_goal(NAME, prompt="wave")
    await rig.until_at("shoulder_pan", 0.3)
    aligned = len(rig.ticks.ticks)
    assert rig.ticks.longest_step() <= ALIGN_RAD_S / RATE_HZ + 1e-6
    rig.lead("shoulder_pan", -0.3)
    await rig.until_at("shoulder_pan", -0.3)
    assert ALIGN_RAD_S / RATE_HZ < rig.ticks.longest_step(aligned - 1) <= 4.7 / RATE_HZ
    await rig.client.take_over("end")
    result = await goal.result(60)
    assert (result["status"], result["data"]["ended_by"]) == ("succeeded", "operator")
    assert all(tick.intervention for tick in rig.ticks.ticks[:-1])


async def test_a_leader_that_is_unplugged_makes_the_arm_hold_and_then_fails_the_goal(
    rig: Bench,
) -> None:
    goal = await rig.client.send_goal(NAME)
    await rig.until_at("shoulder_pan", 0.0)
    rig.bus.cut()
    rig.lead("shoulder_pan", 1.0)  # nobody hears of it
    result = await goal.result(60)
    assert (result["status"], result["code"]) == ("failed", "state_stale")
    assert "the teleoperator is stale" in result["message"]
    assert rig.parts.hal.sent()["shoulder_pan"] == pytest.approx(0.0, abs=0.01)
    assert not rig.ticks.ticks[-1].result.action_applied
    assert rig.ticks.ticks[-1].intervention
    result = await (await rig.client.send_goal(NAME)).result(60)
    assert (result["status"], result["code"]) == ("failed", "robot_fault")
    rig.bus.mend()
    step = len(rig.ticks.ticks)
    goal = await rig.client.send_goal(NAME)
    # on its way to where the leader is by now
    await eventually(lambda: rig.parts.hal.sent().get("shoulder_pan", 0.0) >= 0.1)
    sag = 0.01  # between the last target and where the arm stands, from which it begins
    assert rig.ticks.longest_step(step - 1) <= ALIGN_RAD_S / RATE_HZ + sag
    await goal.cancel()
    await goal.result(60)


async def test_an_operator_who_pushes_against_a_limit_does_not_fail_the_goal(rig: Bench) -> None:
    goal = await rig.client.send_goal(NAME)
    await rig.until_at("shoulder_pan", 0.0)
    rig.parts.gate._memory.tripped = "a wall"
    await eventually(lambda: sum(not tick.result.action_applied for tick in rig.ticks.ticks) >= 30)
    rig.parts.gate._memory.tripped = ""
    rig.lead("shoulder_pan", 0.1)
    await rig.until_at("shoulder_pan", 0.1)
    await goal.cancel()
    assert (await goal.result(60))["data"]["withheld"] >= 30


async def test_a_take_over_ends_the_policys_use_and_gives_back_to_a_fresh_one(
    rig: Bench,
) -> None:
    goal = await rig.client.send_goal("test/grab", prompt="grab it")
    await rig.until_asked(2)
    assert (await rig.client.take_over("take"))["goal_id"] == goal.goal_id
    assert [use.ended for use in rig.arbiter.uses] == [1]
    asked = len(rig.sidecar.observations)
    rig.lead("shoulder_pan", 0.3)
    await rig.until_at("shoulder_pan", 0.3)
    assert len(rig.sidecar.observations) == asked
    with pytest.raises(BadState, match="already"):
        await rig.client.take_over("take")
    before = len(rig.sidecar.calls)
    rig.sidecar.action = [[0.3, *rig.sidecar.action[0][1:]]] * 3
    back = len(rig.ticks.ticks)
    await rig.client.take_over("give_back")
    await rig.until_phase("running")
    await rig.until_asked(asked + 1)
    assert rig.sidecar.calls[before : before + 3] == ["load", "reset", "get_action"]
    fresh = rig.sidecar.observations[asked]["observation.state"]
    assert fresh[0] == pytest.approx(0.3, abs=0.15)  # the servo lags; the start pose has 0
    assert [use.ended for use in rig.arbiter.uses] == [1, 0]
    assert rig.ticks.longest_step(back - 1) < 0.02  # it did not go to its start pose again
    await goal.cancel()
    assert (await goal.result(60))["status"] == "canceled"
    assert [use.ended for use in rig.arbiter.uses] == [1, 1]
    runs = [tick.intervention for tick in rig.ticks.ticks]
    changes = sum(a != b for a, b in itertools.pairwise(runs))
    assert (runs[0], runs[-1], changes) == (False, False, 2)


async def test_a_policy_that_cannot_go_on_fails_the_goal(rig: Bench) -> None:
    goal = await rig.client.send_goal("test/grab", prompt="grab it")
    await rig.until_phase("running")
    await rig.client.take_over("take")
    rig.sidecar.load_error = RobotFault("out of order")
    await rig.client.take_over("give_back")
    result = await goal.result(60)
    assert (result["status"], result["data"].get("ended_by")) == ("failed", None)
    assert "out of order" in result["message"]


async def test_a_dead_leader_takes_nothing_over(rig: Bench) -> None:
    goal = await rig.client.send_goal("test/grab", prompt="grab it")
    await rig.until_phase("running")
    rig.bus.cut()
    with pytest.raises(RobotFault, match="does not answer"):
        await rig.client.take_over("take")
    asked = len(rig.sidecar.observations)
    await rig.until_asked(asked + 2)  # the policy goes on
    for do in ("give_back", "end"):
        with pytest.raises(BadState, match="does not have the robot"):
            await rig.client.take_over(do)  # type: ignore[arg-type]
    await goal.cancel()
    await goal.result(60)
    with pytest.raises(BadState, match="does not move the robot"):
        await rig.client.take_over("take")


@pytest.mark.nightly  # lerobot's writer and reader, 30 s
async def test_demonstrations_and_take_overs_are_rows_that_lerobot_reads(
    bus: ServoBus,
    calibrated: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    forked_writers: None,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """`vram-runner record` keeps one episode and drops one; then a policy's goal is taken over."""
    recorder = DatasetRecorder(tmp_path / "set", rate_hz=RATE_HZ, cameras=(), robot="bench")
    await asyncio.to_thread(recorder.start)
    async with AsyncExitStack() as stack:
        rig = await bench_of(stack, bus, calibrated, tmp_path, recorder)
        read, write = os.pipe()
        monkeypatch.setattr("sys.stdin", stack.enter_context(os.fdopen(read)))
        words = ["record", "wave", "--episodes", "2", "--endpoint", rig.client.endpoint]
        args = parse(words)
        recording = asyncio.create_task(args.run(args))
        for number, verdict in enumerate(("k", "d", "k")):
            os.write(write, b"\n")
            await rig.five_ticks_more()
            os.write(write, f"\n{verdict}\n".encode())
            while recorder.counts.episodes + recorder.counts.discarded <= number:
                await asyncio.sleep(0.01)
        assert await recording == 0
        os.close(write)
        assert "2 of 2 episodes are kept" in capsys.readouterr().out

        goal = await rig.client.send_goal("test/grab", prompt="grab it")
        await rig.until_asked(2)
        assert parse(["takeover"]).do == "take"
        for do in ("take", "give-back"):
            args = parse(["takeover", do, "--endpoint", rig.client.endpoint])
            assert await args.run(args) == 0
            await rig.five_ticks_more()
        await rig.until_phase("running")
        await goal.cancel()
        await goal.result(60)
    await asyncio.to_thread(recorder.close)

    monkeypatch.setenv("HF_HUB_OFFLINE", "1")
    import datasets
    from lerobot.datasets import LeRobotDataset

    monkeypatch.setattr(datasets.config, "HF_DATASETS_CACHE", tmp_path / "cache")
    dataset = LeRobotDataset("local/set", root=tmp_path / "set", video_backend="pyav")
    assert dataset.meta.total_episodes == 3
    assert dataset.features["intervention"] == {"dtype": "bool", "shape": (1,), "names": None}
    rows = [dataset[index] for index in range(len(dataset))]
    shown = {
        episode: [bool(row["intervention"]) for row in rows if row["episode_index"] == episode]
        for episode in range(3)
    }
    assert {row["task"] for row in rows if row["episode_index"] < 2} == {"wave"}
    assert all(shown[0][:-1])
    assert all(shown[1][:-1])
    told = [tick.intervention for tick in rig.ticks.ticks if tick.goal.rskill_id == "test/grab"]
    assert shown[2] == told[-len(shown[2]) :]
    assert {*shown[2]} == {True, False}


def test_keys_move_joints_while_they_are_pressed(monkeypatch: pytest.MonkeyPatch) -> None:
    """lerobot's own keyboard, with a stand-in for the listener of X11."""
    from lerobot.teleoperators.keyboard import teleop_keyboard as module

    class Listener:
        def __init__(self, on_press: Any, on_release: Any) -> None:
            self.press, self.release = on_press, on_release
            self.alive = False

        def start(self) -> None:
            self.alive = True

        def stop(self) -> None:
            self.alive = False

        def is_alive(self) -> bool:
            return self.alive

    keys = SimpleNamespace(Listener=Listener, Key=SimpleNamespace(esc="esc"))
    monkeypatch.setattr(module, "require_package", lambda *_, **__: None)
    monkeypatch.setattr(module, "pynput_can_capture", lambda: True)
    monkeypatch.setattr(module, "PYNPUT_AVAILABLE", True)
    monkeypatch.setattr(module, "keyboard", keys)
    config = TeleopConfig(adapter="lerobot:keyboard")
    made = make_teleoperator(config, so101(simulated=True), None, period_s=1 / RATE_HZ)
    assert isinstance(made, Keyboard)
    made.start()
    try:
        assert made.pose() == {}
        made._device.listener.press("q")
        until(lambda: made.pose() == {"shoulder_pan": math.inf})
        made._device.listener.release("q")
        made._device.listener.press("h")
        until(lambda: made.pose() == {"gripper": -math.inf})
    finally:
        made.stop()
    monkeypatch.setattr(module, "pynput_can_capture", lambda: False)
    with pytest.raises(RobotFault, match="no keys can be read here"):
        made.start()


@pytest.mark.parametrize(
    ("transport", "said"),
    [
        ({"prt": "x"}, r"teleop.transport.prt: unknown key"),
        ({"use_degrees": False}, r"teleop.transport: shoulder_pan comes in -100..100"),
    ],
)
def test_a_teleoperator_that_does_not_fit_is_refused_by_line_and_field(
    bus: ServoBus, calibrated: Path, transport: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=r"robot.yaml:4: " + said):
        parts_of(bus, calibrated, **transport)


@pytest.mark.parametrize(
    ("adapter", "said"),
    [
        ("so101_leader", "known here: lerobot:TYPE"),
        ("lerobot:so102_leader", "lerobot knows no teleoperator"),
    ],
)
def test_an_unknown_teleoperator_is_refused(adapter: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        make_teleoperator(TeleopConfig(adapter=adapter), so101(simulated=True), None, period_s=0.1)
