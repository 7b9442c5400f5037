"""`vram-runner sim`: run a simulated world and serve goals, or let a policy play.

Composes the parts and nothing else.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli.common import (
    AS_FAST_AS_POSSIBLE_HZ,
    add_serving_flags,
    announce,
    check_endpoint,
    check_sidecars,
    connect_arbiter,
    default_skills,
    install_signals,
    sidecars_given,
    unlicensed,
    warm_up,
)
from vram_arbiter.runner.cli.display import add_display_flag, check_display_flag, display_runner
from vram_arbiter.runner.cli.numbers import not_negative, positive_int
from vram_arbiter.runner.cli.recording import (
    Recording,
    add_push_flags,
    check_recording,
    conclude_recording,
    lerobot_units_for,
    record_into,
)
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.schemas.errors import ConfigError, InternalError
from vram_arbiter.schemas.runtime.endpoints import program_endpoint
from vram_arbiter.schemas.runtime.extras import need

if TYPE_CHECKING:
    from vram_arbiter.runner.sim.policies import Policy
    from vram_arbiter.runner.sim.worlds import World

log = logging.getLogger("runner")

SERVES = True


def add_world_flags(parser: argparse.ArgumentParser) -> None:
    """Flags that say what is simulated."""
    parser.add_argument(
        "--env", default="so101", help="so101 (default), or gym:ID for a gymnasium environment"
    )
    parser.add_argument(
        "--scene", type=Path, help="scene file of so101; without it the built-in table"
    )
    parser.add_argument(
        "--env-config",
        type=Path,
        help="environment file of a gymnasium environment (docs/reference/simulated-worlds.md)",
    )
    parser.add_argument(
        "--success",
        metavar="RULE",
        help="success in a gymnasium environment: info:KEY or return:NUMBER",
    )
    parser.add_argument(
        "--max-steps", type=positive_int, help="end an episode after this many steps"
    )


def add_parser(
    commands: argparse._SubParsersAction[argparse.ArgumentParser],
) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner sim`."""
    sim = commands.add_parser("sim", help="simulate the SO-101 on a mobile base, or another world")
    add_world_flags(sim)
    sim.add_argument(
        "--policy",
        help="random, scripted:MODULE, scripted:FILE.py or, in so101, expert (grabs) plays"
        " --episodes episodes, and no goals are accepted",
    )
    sim.add_argument(
        "--episodes", type=positive_int, help="number of episodes of --policy; default 1"
    )
    sim.add_argument("--seed", type=int, default=0, help="seed of the episode")
    sim.add_argument(
        "--record", type=Path, metavar="DIR",
        help="write every goal, or episode of --policy, as an episode of the LeRobotDataset"
        " in this folder, which is new or has an earlier recording",
    )  # fmt: skip
    sim.add_argument(
        "--record-format", choices=("full", "lerobot"), default="full",
        help="columns of the dataset: all, or those of lerobot-record with its names and units",
    )  # fmt: skip
    add_push_flags(sim)
    add_display_flag(sim)
    sim.add_argument("--video", type=Path, help="write the episode as H.264 video to this file")
    sim.add_argument(
        "--timings",
        type=Path,
        help="at the end, write when each tick began and how long it took, one JSON line each",
    )
    sim.add_argument(
        "--rate", type=not_negative, default=30.0, help="ticks per second; 0: as fast as possible"
    )
    sim.add_argument(
        "--deadline-policy", choices=("warn", "drop", "raise"), default="warn",
        help="what to do with a late action: send it, drop it, or end the run; default warn",
    )  # fmt: skip
    sim.add_argument(
        "--lockstep", action=argparse.BooleanOptionalAction, default=True,
        help="let the simulated world wait for the policy's chunks, so that a slow machine only"
        " takes longer",
    )  # fmt: skip
    add_serving_flags(sim)
    return sim


async def run(args: argparse.Namespace) -> int:
    """Build everything, serve until a signal, `shutdown` or `--max-seconds`, or play until the last
    episode; end.
    """
    endpoint = args.endpoint or program_endpoint("runner", os.environ, os.getuid())
    if args.policy is None:
        check_endpoint(endpoint)
    need("the simulator", "numpy", "cv2", extra="runner")
    from vram_arbiter.runner.control.clock import SystemClock
    from vram_arbiter.runner.control.realtime import leaves_room, make_prompt
    from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests
    from vram_arbiter.runner.goals.server import GoalServer
    from vram_arbiter.runner.gpu_lease import RENDERER_BYTES, RENDERING, gpu_lease, rendering_gpu
    from vram_arbiter.runner.protocols import DeadlinePolicy
    from vram_arbiter.runner.recording.video import VideoRecorder
    from vram_arbiter.runner.robots.so101 import lerobot_units_of
    from vram_arbiter.runner.sim.robot import sim_runner
    from vram_arbiter.runner.sim.truth import truth_as_wire
    from vram_arbiter.runner.sim.worlds import makers_of, world_of
    from vram_arbiter.runner.skills.sidecar_policy import LOCKSTEP_WAIT_S

    world = world_of(
        args.env,
        scene=args.scene,
        env_config=args.env_config,
        success=args.success,
        render=True if args.video is not None else None,
    )
    if args.episodes is not None and args.policy is None:
        raise ConfigError("--episodes is for --policy; goals end their episodes themselves")
    if args.record is None and (args.push_to_hub is not None or args.record_format != "full"):
        raise ConfigError("--push-to-hub and --record-format are for --record DIR")
    robot = world.robot
    joints, units = ((), None) if robot is None else (robot.joint_names, lerobot_units_of(robot))
    lerobot = lerobot_units_for(units, world.name) if args.record_format == "lerobot" else None
    check_display_flag(args)
    check_output("--video", args.video)
    check_output("--timings", args.timings)
    policy, told = (None, lambda: "") if args.policy is None else policy_in(world, args.policy)
    manifests = [] if policy is not None else read_manifests(args.skills or [default_skills()])
    given = sidecars_given(args.sidecar)
    if policy is None:
        check_sidecars(given, manifests)
    period_s = 1.0 / (args.rate or AS_FAST_AS_POSSIBLE_HZ)
    wait_s = LOCKSTEP_WAIT_S if args.lockstep or args.rate == 0 else 0.0
    clock = SystemClock()

    dataset = None
    stopping = asyncio.Event()
    async with contextlib.AsyncExitStack() as stack:
        alone = args.no_arbiter or policy is not None  # such a policy needs no GPU memory
        arbiter = None if alone else await connect_arbiter(args.arbiter, stack)
        if arbiter is not None:  # before the first picture is rendered
            gpu = rendering_gpu(os.environ)
            await stack.enter_async_context(gpu_lease(arbiter, gpu, RENDERING, RENDERER_BYTES))
        recorder = None
        if args.video is not None:
            patient = policy is not None and args.rate == 0  # nothing else waits for this world
            recorder = VideoRecorder(
                args.video, fps=1.0 / period_s / world.video_every, wait=patient
            )
            stack.callback(recorder.close)
        runner = sim_runner(
            world.make,
            cameras=world.cameras,
            seed=args.seed,
            rate_hz=args.rate,
            deadline_policy=DeadlinePolicy(args.deadline_policy),
            clock=clock,
            episodes=None if policy is None else args.episodes or 1,
            max_steps=args.max_steps,
            policy=None if policy is None else policy.play,
            told=told,
            video_camera=world.video_camera,
            video_every=world.video_every,
        )
        runner.identity = dict(world.identity)
        if policy is not None:
            runner.identity["policy"] = policy.name
            runner.robot.video.recorder = (
                recorder  # from its first step on: the run may be over before the socket is bound
            )
        runner.spans.share = args.trace_ticks
        if args.record is not None:
            name = str(runner.identity["robot"])
            strict = policy is not None  # it plays for the recording
            dataset = await record_into(
                Recording(args.record, args.rate, name, joints, lerobot, strict),
                runner,
                runner.request_stop if strict else stopping.set,
                stack,
            )
        display_runner(args, runner, arbiter, stack)
        control = await stack.enter_async_context(ControlThread(runner))
        await asyncio.to_thread(warm_up)
        await ready(control)
        if dataset is not None and robot is not None and policy is None:
            await check_recording(dataset, control, runner)
        await make_prompt(control, first=args.realtime and leaves_room(args.rate))
        arm = world.arm

        def bound() -> None:
            # not before: a second runner must not touch the first's video
            runner.robot.video.recorder = recorder
            announce(endpoint)

        server = GoalServer(
            endpoint,
            control,
            runner,
            Catalogue(
                manifests,
                makers_of(world, given, arbiter, period_s=period_s, wait_s=wait_s),
                refused=unlicensed(manifests, allow_noncommercial=args.allow_noncommercial),
                body=world.body,
            ),
            clock,
            ground_truth=None if arm is None else lambda: truth_as_wire(arm),
            on_bound=bound,
            reset=runner.robot.begin_episode_of,
            identity={
                **runner.identity,
                "simulated": True,
                "seed": args.seed,
                "arbiter": arbiter is not None,
            },
            mark=None if dataset is None else dataset.mark,
            stopping=stopping,
            realtime=args.realtime,
        )
        install_signals(stopping)
        try:
            async with asyncio.timeout(args.max_seconds):
                # a policy by itself takes no goals, and has a place beside a runner that does
                await (server.serve() if policy is None else played(control, stopping))
        except TimeoutError:
            log.info("ending after %.0f s, as asked", args.max_seconds)
    result = runner.result()
    log.info(
        "%d ticks, %d late, p99 %.1f ms",
        result.n_ticks,
        result.budget_violations,
        result.p99_tick_ms,
    )
    print(result.model_dump_json())
    if args.timings is not None:
        try:
            runner.timings.write(args.timings)
        except OSError as error:
            raise ConfigError(f"--timings {args.timings} cannot be written: {error}") from error
    if runner.robot.policy_error is not None:
        raise runner.robot.policy_error
    if policy is not None and dataset is not None and dataset.counts.error is not None:
        raise dataset.counts.error  # it was played for the recording
    await conclude_recording(dataset, args)
    return 1 if control.ended.exception() is not None else 0


def policy_in(world: World, name: str) -> tuple[Policy, Callable[[], str]]:
    """Return the policy of `--policy` in a world, and the task of its present episode in words.

    Raises ConfigError for a policy that is unknown, or not for this world.
    """
    from vram_arbiter.runner.sim.policies import policy_of
    from vram_arbiter.runner.sim.tasks import EXPERT, GRAB, expert_policy, set_task

    arm, environment = world.arm, world.environment
    if name != EXPERT:
        return policy_of(name), lambda: world.instruction
    if arm is None or environment is None:
        raise ConfigError(f"--policy {EXPERT} grabs in so101, and does nothing else")
    set_task(GRAB, arm, environment)
    return expert_policy(arm, environment), lambda: GRAB.told(arm)[0]


async def played(control: ControlThread, stopping: asyncio.Event) -> None:
    """Wait for the end of the last episode, or for a signal."""
    stopped = asyncio.create_task(stopping.wait())
    ends: set[asyncio.Future[Any]] = {control.ended, stopped}
    try:
        await asyncio.wait(ends, return_when=asyncio.FIRST_COMPLETED)
    finally:
        stopped.cancel()


async def ready(control: ControlThread) -> None:
    """Wait until the scene stands and the cameras have rendered.

    Raises what the first reset raised.
    """
    try:
        await control.call(lambda: None)
    except InternalError:
        await asyncio.wait([control.ended])
        if (error := control.ended.exception()) is not None:
            raise error from None
