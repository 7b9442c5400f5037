"""Small real parts for the runner's tests: a clock that moves only when told, a robot without
physics.
"""

import asyncio
import math
from collections.abc import Callable, Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.runner.manual_clock import ManualClock
from tests.support.prepared import warm
from vram_arbiter.runner.protocols import Joint, MobileBase, RobotDescription
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.robot import SimRunner, sim_runner
from vram_arbiter.schemas.world import CameraModel

JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


KINEMATIC = RobotDescription(
    "kinematic",
    tuple(
        Joint(
            name,
            -0.5 if name == "shoulder_pan" else -2.0,
            0.5 if name == "shoulder_pan" else 2.0,
            max_speed_rad_s=30.0,
            gripper=name == "gripper",
        )
        for name in JOINTS
    ),
    rest_pose_rad={},
    simulated=True,
    base=MobileBase(max_speed_m_s=0.5, max_turn_rad_s=1.2),
)


class KinematicEnv:
    """Joints go where they are told at once, the base integrates its velocity, cameras see nothing
    but know their size.
    """

    def __init__(self) -> None:
        self.joints = dict.fromkeys(JOINTS, 0.0)
        self.base = (0.0, 0.0, 0.0)
        self.resets: list[int] = []
        self.steps: list[tuple[Any, Any]] = []
        self.closed = 0
        self.fails = False

    def reset(self, seed: int) -> None:
        self.resets.append(seed)
        self.joints = dict(zip(JOINTS, (0.0, -1.20, 1.05, 1.35, 0.0, 0.60), strict=True))
        self.base = (0.0, 0.0, 0.0)

    def step(
        self,
        arm_target: Mapping[str, float] | None,
        base_velocity: tuple[float, float, float] | None = None,
    ) -> None:
        if self.fails:
            raise ValueError("the physics blew up")
        self.steps.append((arm_target, base_velocity))
        if arm_target is not None:
            # all of them, as the simulator wants it
            self.joints = {name: arm_target[name] for name in JOINTS}
        vx, vy, wz = base_velocity or (0.0, 0.0, 0.0)
        x, y, yaw = self.base
        cos, sin = math.cos(yaw), math.sin(yaw)
        self.base = (x + (cos * vx - sin * vy) / 30, y + (sin * vx + cos * vy) / 30, yaw + wz / 30)

    @property
    def time_s(self) -> float:
        return len(self.steps) / 30

    def joint_state(self) -> dict[str, float]:
        return dict(self.joints)

    def joint_velocity(self) -> dict[str, float]:
        return dict.fromkeys(JOINTS, 0.0)

    def base_pose(self) -> tuple[float, float, float]:
        return self.base

    def render(self, camera: str) -> Any:
        import numpy as np

        return np.zeros((24, 32, 3), dtype=np.uint8)

    def camera_model(self, camera: str) -> CameraModel:
        return CameraModel(
            K=((30.0, 0.0, 16.0), (0.0, 30.0, 12.0), (0.0, 0.0, 1.0)),
            T_base_camera=(
                (1.0, 0.0, 0.0, 0.0),
                (0.0, -1.0, 0.0, 0.0),
                (0.0, 0.0, -1.0, 1.0),
                (0.0, 0.0, 0.0, 1.0),
            ),
        )

    def close(self) -> None:
        self.closed += 1


def world_of(
    env: KinematicEnv,
    judge: Callable[[KinematicEnv], bool] | None = None,
    cameras: tuple[str, ...] = (),
) -> ArmEnvironment:
    """Return the kinematic robot as a world, with a task's verdict."""
    arm: Any = env
    told = None if judge is None else lambda: judge(env)
    return ArmEnvironment(arm, KINEMATIC, judge=told, cameras=cameras)


@pytest.fixture(scope="session")
def kinematic() -> RobotDescription:
    """What the gate knows of `KinematicEnv`."""
    return KINEMATIC


@pytest.fixture
def clock() -> ManualClock:
    return ManualClock()


@pytest.fixture
def programs() -> Iterator[list[Any]]:
    """Processes of a test, which end with it."""
    started: list[Any] = []
    yield started
    for process in started:
        if process.poll() is None:
            process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def make_env() -> type[KinematicEnv]:
    return KinematicEnv


@pytest.fixture
def env() -> KinematicEnv:
    return KinematicEnv()


@pytest.fixture
def make_runner(env: KinematicEnv) -> Callable[..., SimRunner]:
    """A SimRunner on the kinematic robot; no cameras unless asked for, so that no picture library
    is needed. `judge` looks at the robot.
    """

    def make(**options: Any) -> SimRunner:
        cameras = options.pop("cameras", ())
        return sim_runner(world_of(env, options.pop("judge", None), cameras), **options)

    return make


@pytest.fixture
def navigate_manifest() -> Path:
    return Path(__file__).parents[2] / "configs/rskills/so101-navigate/rskill.yaml"


@pytest.fixture
def endpoint(tmp_path: Path) -> str:
    return f"ipc://{tmp_path}/runner.sock"


@pytest.fixture(scope="module")
def forked_writers() -> Iterator[None]:
    """Let recorders of this process, and of runners that it forks, fork their writers."""
    from tests.support.dataset_writer import FORKING
    from vram_arbiter.runner.recording import recorder

    warm("dataset-writer")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "subprocess", FORKING)
        yield


@pytest.fixture
def forked_workers() -> Iterator[None]:
    """Let benchmarks of this process fork their workers."""
    from tests.support.benchmark_workers import FORKING
    from vram_arbiter.runner.benchmark import processes

    warm("vram-runner")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(processes, "subprocess", FORKING)
        yield


@pytest.fixture
def run_async() -> Callable[[Any], Any]:
    """Runs a coroutine to its end, at most a minute."""

    def run(coroutine: Any) -> Any:
        async def bounded() -> Any:
            async with asyncio.timeout(60):
                return await coroutine

        return asyncio.run(bounded())

    return run
