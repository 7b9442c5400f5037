"""`vram-runner deploy --config FILE`: run a robot and serve goals, or do the file's one task.

Composes the parts and nothing else. A signal ends it in order: the goal is canceled, the arm holds,
the robot is disconnected.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import re
from collections.abc import AsyncIterator, Mapping
from pathlib import Path

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.common import (
    add_serving_flags,
    announce,
    check_endpoint,
    check_sidecars,
    connect_arbiter,
    default_skills,
    install_signals,
    sidecars_given,
    start_sidecars,
)
from vram_arbiter.runner.cli.deployment import (
    DeploymentFile,
    Parts,
    make_parts,
    offered,
    plan,
    read_deployment,
    skill_named,
    unkept,
    unused,
)
from vram_arbiter.runner.cli.display import add_display_flag, check_display_flag, display_runner
from vram_arbiter.runner.cli.makers import Models, policy_makers
from vram_arbiter.runner.cli.recording import (
    check_recording,
    conclude_recording,
    record_into,
)
from vram_arbiter.runner.cli.servers import connect_servers, remote_sidecars
from vram_arbiter.runner.cli.watching import Watch, slots_of, watches, watching
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.loop import ControlLoop
from vram_arbiter.runner.control.realtime import leaves_room, make_prompt
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests, sidecar_endpoint
from vram_arbiter.runner.goals.server import GoalServer
from vram_arbiter.runner.gpu_lease import DECODER_BYTES, DECODING, cuda_uuid, gpu_lease
from vram_arbiter.runner.protocols import DeadlinePolicy, GoalData
from vram_arbiter.runner.robots.hardware import HardwareRobot, HardwareRunner
from vram_arbiter.runner.safety.estop_latch import EstopLatch
from vram_arbiter.runner.safety.estop_mark import EstopMark
from vram_arbiter.runner.sensors.ros2_estop import estop_topic, listened_topic
from vram_arbiter.runner.skills import teleop
from vram_arbiter.schemas.config.robot import RobotEnvironment
from vram_arbiter.schemas.errors import (
    AlreadyRunning,
    RunnerUnreachable,
    VramError,
)
from vram_arbiter.schemas.goals import ResultPush
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.runtime.endpoints import program_endpoint, runtime_dir
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder
from vram_arbiter.schemas.runtime.printable import printable_lines
from vram_arbiter.schemas.world import RunResult

log = logging.getLogger("runner")

SERVES = True
OWN_GOAL = "task"  # goal id of the file's own task


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner deploy`."""
    deploy = commands.add_parser("deploy", help="run the robot of a deployment file")
    deploy.add_argument(
        "--config",
        type=Path,
        required=True,
        help="deployment file (docs/reference/deployment-file.md), or the name of a shipped one",
    )
    deploy.add_argument(
        "--dry-run",
        "--check",
        action="store_true",
        help="check everything, print what would run, open nothing",
    )
    add_display_flag(deploy)
    add_serving_flags(deploy)
    return deploy


async def run(args: argparse.Namespace) -> int:
    """Deploy the robot.

    Returns: 0 ended on request, or the task succeeded; 1 it failed; 2 a person has to act (a wrong
    file or flag, or a task that the emergency stop ended).
    """
    file = read_deployment(shipped(args.config, "robots", configs_folder(os.environ)))
    return await Deploy(args, file).run()


class Deploy:
    """One run of the command."""

    def __init__(self, args: argparse.Namespace, file: DeploymentFile) -> None:
        self._args = args
        self._file = file
        self._clock = SystemClock()
        self._endpoint: str = args.endpoint or program_endpoint("runner", os.environ, os.getuid())
        self._stopping = asyncio.Event()
        self._task_skill = ""
        self._watches: tuple[Watch, ...] = ()

    async def run(self) -> int:
        """Check, then print the plan or carry it out."""
        taken = self._taken()
        check_display_flag(self._args)
        parts = make_parts(self._file, self._clock)
        recorder = None
        manifests = read_manifests(self._args.skills or [default_skills()])
        if parts.teleoperator is not None:
            manifests.append(teleop.MANIFEST)
        given = sidecars_given(self._args.sidecar)
        check_sidecars(given, manifests)
        remote = remote_sidecars(self._file, manifests, os.environ)
        remote = {skill: ends for skill, ends in remote.items() if skill not in given}
        given |= {skill: sidecar for skill, (sidecar, _) in remote.items()}
        check = self._offered(parts, manifests, Models(given))
        self._watches = watches(self._file, manifests, given, os.environ)
        if self._file.robot.vla is not None:
            self._task_skill = skill_named(self._file.robot.vla, check.executable())
        if self._args.dry_run:
            print(
                printable_lines(
                    plan(self._file, parts, check, [*self._facts(check, given), *taken])
                )
            )
            print("dry run: nothing was opened")
            return 0
        for text in (*unkept(self._file, parts, check), *unused(self._file.robot)):
            log.warning("%s is not kept", text)
        async with contextlib.AsyncExitStack() as stack:
            claim(self._file.robot, stack)
            await start_sidecars(self._args, stack)
            install_signals(self._stopping)
            mark = EstopMark(_robot_file("robot", self._file.robot.robot_id, "estop"))
            mark.refuse_if_left()
            arbiter = (
                None if self._args.no_arbiter else await connect_arbiter(self._args.arbiter, stack)
            )
            models = Models(given, arbiter, await connect_servers(remote, stack))
            decoders = sum(getattr(one, "decodes_on_gpu", False) for one in parts.readers)
            gpu = cuda_uuid(0) if decoders else None  # where GStreamer's decoders run
            await stack.enter_async_context(
                gpu_lease(arbiter, gpu, DECODING, decoders * DECODER_BYTES)
            )
            runner = self._runner(parts, mark)
            topic = listened_topic(self._file.robot)
            stack.enter_context(estop_topic(topic, runner.request_estop))
            runner.spans.share = self._args.trace_ticks
            robot = self._file.robot
            if robot.save_dir is not None:
                lerobot = parts.lerobot_units if robot.save_format == "lerobot" else None
                recorder = await record_into(
                    Path(robot.save_dir),
                    runner,
                    self._stopping.set,
                    stack,
                    robot.rate_hz,
                    robot.robot_id,
                    lerobot,
                )
            display_runner(self._args, runner, robot.robot_id, arbiter, stack)
            control = await self._start(runner, stack)
            if control is None:
                return 0
            if recorder is not None:
                await check_recording(recorder, control)
            await stack.enter_async_context(watching(self._watches, runner.robot, self._clock))
            await make_prompt(control, first=self._args.realtime and leaves_room(robot.rate_hz))
            catalogue = self._offered(parts, manifests, models)
            server = GoalServer(
                self._endpoint,
                control,
                catalogue,
                self._clock,
                identity=self._identity(parts, arbiter),
                on_bound=lambda: announce(self._endpoint),
                mark=None if recorder is None else recorder.mark,
                stopping=self._stopping,
                realtime=self._args.realtime,
            )
            ended = await self._serve(server, runner)
        failed = control.ended.exception() is not None
        if not failed:
            mark.remove()
        code = self._conclude(runner, ended, failed)
        await conclude_recording(recorder)
        return code

    # -- steps
    def _offered(self, parts: Parts, manifests: list[RSkillManifest], models: Models) -> Catalogue:
        makers = policy_makers(self._file.robot, parts, models)
        return offered(self._file, parts, manifests, makers, self._args.allow_noncommercial)

    def _taken(self) -> list[tuple[str, str]]:
        """Check the endpoint; return a line of the plan where a dry run finds it in use, as by the
        runner that this file is to replace. Raises ConfigError, AlreadyRunning."""
        try:
            check_endpoint(self._endpoint)
        except AlreadyRunning as error:
            if not self._args.dry_run:
                raise
            return [("TAKEN", str(error))]
        return []

    def _facts(self, catalogue: Catalogue, given: Mapping[str, str]) -> list[tuple[str, str]]:
        sidecars = [
            (
                "sidecar",
                f"of {manifest.name} at {sidecar_endpoint(manifest.name, given, os.environ)}",
            )
            for manifest in catalogue.executable()
            if manifest.kind is Kind.VLA
        ]
        arbiter = "none" if self._args.no_arbiter else self._args.arbiter or "the machine's own"
        sidecars += [watch.line for watch in self._watches]
        return [*sidecars, ("goals", f"served on {self._endpoint}"), ("arbiter", arbiter)]

    def _identity(self, parts: Parts, arbiter: AsyncClient | None) -> GoalData:
        return {
            "robot": self._file.robot.robot_id,
            "simulated": parts.hal.description.simulated,
            "arbiter": arbiter is not None,
        }

    def _runner(self, parts: Parts, mark: EstopMark) -> HardwareRunner:
        def stopped(reason: str) -> None:
            parts.gate.trip(reason)
            mark.leave(reason)

        robot, latch = self._file.robot, EstopLatch(stopped)
        ages = {sensor.sensor_id: sensor.max_age_ms for sensor in robot.sensors}
        hardware = HardwareRobot(
            parts.hal,
            [(reader, ages[reader.sensor_id]) for reader in parts.readers],
            lambda skill: parts.gate.for_skill(skill.manifest, skill.cameras),
            clock=self._clock,
            latch=latch,
            topics={s.sensor_id: s.publish_topic for s in robot.sensors if s.publish_topic},
            detections=slots_of(self._watches),
            sync=robot.sync,
        )
        return ControlLoop(
            hardware,
            rate_hz=robot.rate_hz,
            deadline_policy=DeadlinePolicy(robot.deadline_overrun_policy),
            latency_budget_ms=robot.latency_budget_ms,
            clock=self._clock,
            latch=latch,
        )

    async def _start(
        self, runner: HardwareRunner, stack: contextlib.AsyncExitStack
    ) -> ControlThread | None:
        """Return the control thread with robot and cameras at work; None when a signal came
        first.
        """
        async with _stop_on(self._stopping, runner):
            try:
                return await stack.enter_async_context(
                    ControlThread(runner, max_ticks=self._file.robot.max_ticks)
                )
            except VramError:
                if self._stopping.is_set():
                    log.info("stopped before anything moved")
                    return None
                raise

    async def _serve(self, server: GoalServer, runner: HardwareRunner) -> ResultPush | None:
        """Serve until a signal, `shutdown` or the end of the file's task; return its result."""
        task = self._file.robot.task
        own = asyncio.create_task(self._own_task(server, runner)) if task is not None else None
        try:
            await server.serve()
        finally:
            if own is not None and not own.done():
                own.cancel()
                await asyncio.gather(own, return_exceptions=True)
        if own is not None and not own.cancelled():
            own.result()  # raises what kept the task from being a goal at all
        return server.result_of(OWN_GOAL)

    async def _own_task(self, server: GoalServer, runner: HardwareRunner) -> None:
        """Run the file's task as a goal like any other; its end ends the program.

        After an emergency stop the program stays: disconnecting may cut the torque, and a person
        decides about that.
        """
        robot = self._file.robot
        if robot.task is None or robot.vla is None:
            return
        await server.bound.wait()
        try:
            async with RunnerClient(self._endpoint) as client:
                goal = await client.send_goal(
                    self._task_skill,
                    prompt=robot.task.instruction,
                    max_ticks=robot.task.max_steps,
                    goal_id=OWN_GOAL,
                )
                await goal.result()
        except RunnerUnreachable:
            if not server.stopping.is_set():
                raise
        finally:
            if runner.estop is None:
                server.stopping.set()

    def _conclude(self, runner: HardwareRunner, ended: ResultPush | None, failed: bool) -> int:
        robot = self._file.robot
        result = runner.result()
        success: bool | None = None
        if ended is not None and ended["status"] != "canceled":
            key = robot.task.success_key if robot.task is not None else None
            success = ended["success"] and (key is None or ended["data"].get(key) is True)
            log.info(
                "task %s %s", "done:" if success else "not done:", ended["message"] or ended["data"]
            )
        print(summary(result, runner, success, robot.robot_id))
        if not failed and success is not False:
            return 0
        return (
            1 if runner.estop is None else 2
        )  # 2: a supervisor that restarts failed programs must not restart this one


def claim(robot: RobotEnvironment, stack: contextlib.AsyncExitStack) -> None:
    """Claim the robot and its port for this process.

    A port counts as well because a robot may have several names. Raises AlreadyRunning before a
    second runner touches the motors of the first.
    """
    _claim(f"robot {robot.robot_id}", robot.robot_id, stack)
    sections = (robot.hal, robot.teleop)
    for port in (one.transport.get("port") for one in sections if one is not None):
        if port:
            _claim(f"port {port}", os.path.realpath(str(port)), stack)


def _robot_file(kind: str, key: str, suffix: str) -> Path:
    """Return a file of this robot, or port, in the runtime folder, which is created."""
    folder = Path(runtime_dir(os.environ, os.getuid()))
    private_folder(folder, shared=True)
    return folder / f"{kind}-{re.sub(r'[^A-Za-z0-9._-]', '_', key)}.{suffix}"


def _claim(what: str, key: str, stack: contextlib.AsyncExitStack) -> None:
    lock = LockFile(_robot_file(what.partition(" ")[0], key, "lock"), what, "a runner")
    lock.acquire()
    stack.callback(lock.release)


def summary(result: RunResult, runner: HardwareRunner, success: bool | None, robot_id: str) -> str:
    """Return the run as one line of JSON."""
    facts = {
        "robot": robot_id,
        "robot_model": runner.robot.hal.description.name,
        "estop": runner.estop.message if runner.estop else None,
        "violations": list(runner.slot.violations)[-8:],
    }
    full = result.model_copy(update={"success": success, "metadata": {**result.metadata, **facts}})
    return full.model_dump_json()


@contextlib.asynccontextmanager
async def _stop_on(stopping: asyncio.Event, runner: HardwareRunner) -> AsyncIterator[None]:
    """While inside, a signal makes the runner give up what it waits for."""

    async def forward() -> None:
        await stopping.wait()
        runner.request_stop()

    task = asyncio.create_task(forward())
    try:
        yield
    finally:
        task.cancel()
        await asyncio.gather(task, return_exceptions=True)
