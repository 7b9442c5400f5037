"""`vram-runner sim`: run a simulated robot and serve goals.

Composes the parts and nothing else.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
from pathlib import Path

from vram_arbiter.clients.cli.arguments import at_least
from vram_arbiter.clients.output_paths import check_output
from vram_arbiter.runner.cli import Commands
from vram_arbiter.runner.cli.common import (
    AS_FAST_AS_POSSIBLE_HZ,
    add_serving_flags,
    announce,
    check_endpoint,
    check_sidecars,
    connect_arbiter,
    default_skills,
    install_signals,
    lease_rendering,
    sidecars_given,
    start_sidecars,
    unlicensed,
    warm_up,
)
from vram_arbiter.runner.cli.display import add_display_flag, check_display_flag, display_runner
from vram_arbiter.runner.cli.makers import simulated_operator
from vram_arbiter.runner.cli.recording import (
    add_record_flags,
    check_recording,
    conclude_recording,
    record_sim,
)
from vram_arbiter.runner.control.thread import ControlThread
from vram_arbiter.schemas.errors import ConfigError, InternalError
from vram_arbiter.schemas.runtime.endpoints import program_endpoint
from vram_arbiter.schemas.runtime.extras import need

log = logging.getLogger("runner")

SERVES = True
ROBOTS = ("so101-mobile", "panda-mobile")  # keys of `sim.worlds.WORLDS`


def add_parser(commands: Commands) -> argparse.ArgumentParser:
    """Add the parser of `vram-runner sim`."""
    sim = commands.add_parser("sim", help="simulate a robot on a mobile base")
    sim.add_argument(
        "--robot", choices=ROBOTS, default=ROBOTS[0], help="which robot; default %(default)s"
    )
    sim.add_argument("--scene", type=Path, help="scene file; without it the robot's own scene")
    sim.add_argument("--seed", type=int, default=0, help="seed of the scene")
    add_record_flags(sim, "every goal")
    add_display_flag(sim)
    sim.add_argument(
        "--teleop", metavar="FILE", type=Path,
        help="deployment file whose `teleop` moves the arm, on `record` and `takeover`",
    )  # fmt: skip
    sim.add_argument("--video", type=Path, help="write the run as H.264 video to this file")
    sim.add_argument(
        "--timings", type=Path,
        help="at the end, write when each tick began and how long it took, one JSON line each",
    )  # fmt: skip
    sim.add_argument(
        "--rate", type=at_least(0.0), default=30.0, help="ticks per second; 0: as fast as possible"
    )
    sim.add_argument(
        "--lockstep", action=argparse.BooleanOptionalAction, default=True,
        help="let the simulated world wait for the policy's chunks, so that a slow machine only"
        " takes longer",
    )  # fmt: skip
    add_serving_flags(sim)
    return sim


async def run(args: argparse.Namespace) -> int:
    """Build everything, serve until a signal or `shutdown`; end."""
    endpoint = args.endpoint or program_endpoint("runner", os.environ, os.getuid())
    check_endpoint(endpoint)
    need("the simulator", "numpy", "cv2", extra="runner")
    from vram_arbiter.runner.control.clock import SystemClock
    from vram_arbiter.runner.control.realtime import leaves_room, make_prompt
    from vram_arbiter.runner.goals.catalogue import Catalogue, read_manifests
    from vram_arbiter.runner.goals.server import GoalServer
    from vram_arbiter.runner.sim.robot import VIDEO_EVERY, sim_runner
    from vram_arbiter.runner.sim.truth import truth_as_wire
    from vram_arbiter.runner.sim.video import VideoRecorder
    from vram_arbiter.runner.sim.worlds import WORLDS, makers_of
    from vram_arbiter.runner.skills import teleop
    from vram_arbiter.runner.skills.sidecar_policy import LOCKSTEP_WAIT_S

    chosen = WORLDS[args.robot]
    world = chosen.make(args.scene)
    check_display_flag(args)
    check_output("--video", args.video)
    check_output("--timings", args.timings)
    manifests = read_manifests(args.skills or [default_skills()])
    given = sidecars_given(args.sidecar)
    check_sidecars(given, manifests)
    period_s = 1.0 / (args.rate or AS_FAST_AS_POSSIBLE_HZ)
    wait_s = LOCKSTEP_WAIT_S if args.lockstep or args.rate == 0 else 0.0
    operator = simulated_operator(args.teleop, world, period_s)
    if operator:
        manifests.append(teleop.MANIFEST)
    clock = SystemClock()
    stopping = asyncio.Event()
    async with contextlib.AsyncExitStack() as stack:
        await start_sidecars(args, stack)
        arbiter = None
        if not args.no_arbiter:
            arbiter = await connect_arbiter(args.arbiter, stack)
            await lease_rendering(arbiter, stack)
        recorder = None
        if args.video is not None:
            recorder = VideoRecorder(args.video, fps=1.0 / period_s / VIDEO_EVERY)
            stack.callback(recorder.close)
        runner = sim_runner(
            world,
            seed=args.seed,
            rate_hz=args.rate,
            clock=clock,
        )
        runner.identity = {"robot": args.robot, "scene": str(args.scene or "built-in")}
        runner.spans.share = args.trace_ticks
        dataset = await record_sim(args, runner, args.rate, stopping.set, stack, robot=args.robot)
        display_runner(args, runner, args.robot, arbiter, stack)
        control = await stack.enter_async_context(ControlThread(runner))
        await asyncio.to_thread(warm_up)
        await ready(control)
        if dataset is not None:
            await check_recording(dataset, control)
        await make_prompt(control, first=args.realtime and leaves_room(args.rate))

        def bound() -> None:
            # not before: a second runner must not touch the first's video
            runner.robot.video.recorder = recorder
            announce(endpoint)

        server = GoalServer(
            endpoint,
            control,
            Catalogue(
                manifests,
                makers_of(world, given, arbiter, period_s=period_s, wait_s=wait_s, others=operator),
                refused=unlicensed(manifests, allow_noncommercial=args.allow_noncommercial),
                body=chosen.body,
            ),
            clock,
            ground_truth=lambda: truth_as_wire(world.arm),
            on_bound=bound,
            reset=runner.robot.begin_episode,
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
        await server.serve()
    result = runner.result()
    log.info(
        "%d ticks, %d late, p99 %.1f ms",
        result.n_ticks,
        runner.deadline_misses,
        result.p99_tick_ms,
    )
    print(result.model_dump_json())
    if args.timings is not None:
        try:
            runner.timings.write(args.timings)
        except OSError as error:
            raise ConfigError(f"--timings {args.timings} cannot be written: {error}") from error
    await conclude_recording(dataset)
    return 1 if control.ended.exception() is not None else 0


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
