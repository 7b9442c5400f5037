"""`vram-runner sim`: owns the simulated robot, its cameras and safety, and serves goals. Puts its parts together, and nothing else."""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
from pathlib import Path

from runner.cli_common import (
    add_serving_flags,
    connect_arbiter,
    default_skills,
    install_signals,
    not_negative,
    sidecar_endpoint,
    sidecars_given,
    warm_up,
)
from schemas.endpoints import program_endpoint
from schemas.errors import ConfigError

log = logging.getLogger("runner")

OBSERVATION_CAMERAS = ("front", "wrist")  # the first is the default one
VIDEO_CAMERA = "overview"
VIDEO_EVERY = 3  # ticks: ten pictures a second at 30 Hz
AS_FAST_AS_POSSIBLE_HZ = 30.0  # simulated rate when nothing is paced


def add_parser(commands: argparse._SubParsersAction[argparse.ArgumentParser]) -> argparse.ArgumentParser:
    """The flags of `vram-runner sim`."""
    sim = commands.add_parser("sim", help="the simulated SO-101 on a mobile base")
    sim.add_argument("--scene", type=Path, help="scene file; without it the built-in table")
    sim.add_argument("--seed", type=int, default=0, help="decides everything about the episode")
    sim.add_argument("--video", type=Path, help="write the episode as H.264 video to this file")
    sim.add_argument(
        "--timings",
        type=Path,
        help="write when each tick began and how long it took, a JSON line each, at the end",
    )
    sim.add_argument(
        "--rate", type=not_negative, default=30.0, help="ticks per second; 0: as fast as possible"
    )
    sim.add_argument("--deadline-policy", choices=("warn", "drop", "raise"), default="warn")
    sim.add_argument(
        "--lockstep", action=argparse.BooleanOptionalAction, default=True,
        help="the simulated world waits for the policy's chunks, so that a slow machine changes only how long a run takes",
    )  # fmt: skip
    add_serving_flags(sim)
    return sim


async def run(args: argparse.Namespace) -> int:
    """Build everything, serve until a signal, `shutdown` or `--max-seconds`, end in order."""
    from pydantic import ValidationError

    from clients.sidecar.policy import PolicyClient
    from runner.body import SIMULATED
    from runner.catalogue import Catalogue, Maker, read_manifests
    from runner.clock import SystemClock
    from runner.control import ControlThread
    from runner.goals import GoalServer
    from runner.protocols import DeadlinePolicy, Skill
    from runner.recorder import Recorder
    from runner.sim.arm_env import ArmEnvironment
    from runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
    from runner.sim.env import SimEnv
    from runner.sim.sim_runner import SimRunner
    from runner.sim.truth import truth_as_wire
    from runner.skills.navigate import Navigate
    from runner.skills.sidecar_policy import LOCKSTEP_WAIT_S, SidecarPolicy, wire_up
    from schemas.manifest import Kind, RSkillManifest

    try:
        scene = SceneConfig.load(args.scene)
    except (OSError, ValidationError, ValueError) as error:
        raise ConfigError(f"the scene {args.scene} cannot be read: {error}") from error
    manifests = read_manifests(args.skills or [default_skills()])
    given = sidecars_given(args.sidecar)
    period_s = 1.0 / (args.rate or AS_FAST_AS_POSSIBLE_HZ)
    wait_s = LOCKSTEP_WAIT_S if args.lockstep or args.rate == 0 else 0.0
    clock = SystemClock()
    rest = dict(zip(ARM_JOINTS, REST_POSE, strict=True))

    async with contextlib.AsyncExitStack() as stack:
        arbiter = None if args.no_arbiter else await connect_arbiter(args.arbiter, stack)

        def make_policy(manifest: RSkillManifest) -> Skill:
            client = PolicyClient(sidecar_endpoint(manifest.name, given, os.environ))
            return SidecarPolicy(
                manifest,
                wire_up(manifest, ARM_JOINTS, rest),
                client,
                arbiter,
                period_s=period_s,
                wait_s=wait_s,
            )

        def make_navigate(manifest: RSkillManifest) -> Skill:
            return Navigate(manifest, scene, period_s=period_s)

        makers: dict[Kind, Maker] = {Kind.VLA: make_policy, Kind.ROS_ACTION: make_navigate}
        env = SimEnv(scene)  # renders only on the control thread, from its first reset on
        recorder = None
        if args.video is not None:
            recorder = Recorder(args.video, fps=1.0 / period_s / VIDEO_EVERY)
            stack.callback(recorder.close)
        runner = SimRunner(
            lambda: ArmEnvironment(env),
            cameras=tuple(name for name in OBSERVATION_CAMERAS if name in scene.cameras),
            seed=args.seed,
            rate_hz=args.rate,
            deadline_policy=DeadlinePolicy(args.deadline_policy),
            clock=clock,
            video_camera=VIDEO_CAMERA,
            video_every=VIDEO_EVERY,
        )
        runner.identity = {"robot": "so101-mobile", "scene": str(args.scene or "built-in")}
        control = await stack.enter_async_context(ControlThread(runner))
        await asyncio.to_thread(warm_up)
        await control.call(lambda: None)  # the scene stands and the cameras have rendered: ready means ready
        server = GoalServer(
            args.endpoint or program_endpoint("runner", os.environ, os.getuid()),
            control,
            runner,
            Catalogue(manifests, makers, body=SIMULATED),
            clock,
            ground_truth=lambda: truth_as_wire(env),
            on_bound=lambda: setattr(
                runner, "recorder", recorder
            ),  # not before: a second runner must not touch the first's video
            identity={
                **runner.identity,
                "simulated": True,
                "seed": args.seed,
                "arbiter": arbiter is not None,
            },
        )
        install_signals(server.stopping)
        try:
            async with asyncio.timeout(args.max_seconds):
                await server.serve()
        except TimeoutError:
            log.info("ending after %.0f s, as asked", args.max_seconds)
    result = runner.result()
    log.info("%d ticks, %d late, p99 %.1f ms", result.n_ticks, result.budget_violations, result.p99_tick_ms)
    print(result.model_dump_json())
    if args.timings is not None:
        runner.timings.write(args.timings)
    return 1 if control.ended.exception() is not None else 0
