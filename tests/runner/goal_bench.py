"""A goal server over a real socket, its skill told by each goal's prompt what to do."""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from pathlib import Path
from typing import Any

from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals.catalogue import Catalogue
from vram_arbiter.runner.goals.server import GoalServer
from vram_arbiter.runner.protocols import Act, Done, Goal, Hold, InferenceRunner, StepOutcome
from vram_arbiter.runner.sim.robot import SimRunner
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import Evicted, SidecarUnavailable
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, load_manifest
from vram_arbiter.schemas.world import Action, WorldState

RSKILL = "vram-arbiter/so101-navigate"


class Told(SkillBase):
    """Does what the goal's prompt says: ends, waits, fails, or hangs in its start."""

    def __init__(self, manifest: RSkillManifest) -> None:
        super().__init__(manifest)
        self.story: list[str] = []
        self.traceparents: list[str] = []
        self.begun = asyncio.Event()
        self.finishing, self.finished = asyncio.Event(), asyncio.Event()
        self.loop = asyncio.get_running_loop()

    async def _start(self, goal: Goal) -> None:
        self.story.append(f"start {goal.prompt}")
        self.traceparents.append(goal.traceparent or "")
        self.todo = goal.prompt
        self.steps = 0
        self.begun.clear()
        if goal.prompt == "hang":
            self.phase = "loading: 1 GiB of 4 GiB"
            self.begun.set()
            await asyncio.Event().wait()
        if goal.prompt in ("unavailable", "unavailable for ever"):
            raise SidecarUnavailable("no process", hint="start it")

    def _step(self, world: WorldState) -> StepOutcome:
        self.steps += 1
        self.loop.call_soon_threadsafe(self.begun.set)
        match self.todo:
            case "end with a set":
                return Done({"seen": {1, 2}})
            case "end with a large number":
                return Done({"seen": 2**70})
            case "end" | "end, and leave slowly" | "end slowly" | "end badly" if self.steps > 3:
                return Done({"steps": self.steps})
            case "evicted" if self.steps > 2:
                raise Evicted("another model is there")
            case "defect":
                raise ZeroDivisionError("oops")
        # to and fro within the joints' ranges: "forever" is as long as a test is
        row = (0.01 * (self.steps % 20),) * 2
        names = ("shoulder_pan", "wrist_roll")
        if self.steps % 2:
            return Hold("thinking")
        return Act(
            Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=names)
        )

    async def _finish(self) -> None:
        self.story.append("finish")
        if self.todo == "end slowly":
            self.finishing.set()
            await self.finished.wait()
        if self.todo in ("end badly", "unavailable for ever"):
            raise ZeroDivisionError("oops")

    async def _release(self) -> None:
        self.story.append("release")
        if self.todo == "end, and leave slowly":
            self.finishing.set()
            await self.finished.wait()


class Bench:
    def __init__(self, runner: SimRunner, server: GoalServer, env: Any, made: list[Told]) -> None:
        self.runner, self.server, self.env, self.made = runner, server, env, made


@asynccontextmanager
async def goals_served(
    endpoint: str,
    runner: InferenceRunner,
    catalogue: Catalogue,
    *,
    estop_s: float = 60.0,
    **options: Any,
) -> AsyncIterator[GoalServer]:
    """A goal server on a control thread; `options` are the server's. `estop_s`: short only where
    the loop hangs: a machine that stalls for a second must not look like that."""
    async with ControlThread(runner) as control:
        await control.call(lambda: None)
        server = GoalServer(endpoint, control, catalogue, SystemClock(), estop_s=estop_s, **options)
        task = asyncio.create_task(server.serve())
        await server.bound.wait()
        try:
            yield server
        finally:
            server.stopping.set()
            await task


@asynccontextmanager
async def goal_bench(
    make_runner: Callable[..., SimRunner], env: Any, endpoint: str, manifest: Path
) -> AsyncIterator[Bench]:
    """Serve goals of `RSKILL` at `endpoint`."""
    made: list[Told] = []

    def make(skill: RSkillManifest) -> Told:
        made.append(Told(skill))
        return made[-1]

    runner = make_runner(rate_hz=200.0)
    catalogue = Catalogue([load_manifest(manifest)], {Kind.ROS_ACTION: make})
    truth = {"target": "red cube"}
    async with goals_served(endpoint, runner, catalogue, ground_truth=lambda: truth) as server:
        yield Bench(runner, server, env, made)
