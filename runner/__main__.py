"""The runner's command line and composition root: `python -m runner sim …` owns simulator, cameras and safety and serves goals.

Everything real is put together here and nowhere else. Exit codes: 0 ended on request, 1 failed, 2 wrong usage or configuration.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import logging
import os
import signal
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from clients.configs import configs_folder
from runner import frames
from schemas.endpoints import program_endpoint
from schemas.errors import ArbiterUnreachable, ConfigError, VramError

log = logging.getLogger("runner")

OBSERVATION_CAMERAS = ("front", "wrist")  # the first is the default one
VIDEO_CAMERA = "overview"
VIDEO_EVERY = 3  # ticks: ten pictures a second at 30 Hz
AS_FAST_AS_POSSIBLE_HZ = 30.0  # simulated rate when nothing is paced
ARBITER_RETRY_S = 2.0


def parse(argv: list[str] | None) -> argparse.Namespace:
    """The flags of `python -m runner`."""
    parser = argparse.ArgumentParser(
        prog="vram-runner", description="Runs a robot's skills and serves goals and frames."
    )
    kinds = parser.add_subparsers(dest="robot", required=True)
    sim = kinds.add_parser("sim", help="the simulated SO-101 on a mobile base")
    sim.add_argument("--scene", type=Path, help="scene file; without it the built-in table")
    sim.add_argument("--seed", type=int, default=0, help="decides everything about the episode")
    sim.add_argument(
        "--skills", type=Path, nargs="+", action="extend", help="rskill.yaml files or folders of them"
    )
    sim.add_argument("--video", type=Path, help="write the episode as H.264 video to this file")
    sim.add_argument("--rate", type=float, default=30.0, help="ticks per second; 0: as fast as possible")
    sim.add_argument("--deadline-policy", choices=("warn", "drop", "raise"), default="warn")
    sim.add_argument(
        "--lockstep", action=argparse.BooleanOptionalAction, default=True,
        help="the simulated world waits for the policy's chunks, so that a slow machine changes only how long a run takes",
    )  # fmt: skip
    sim.add_argument("--endpoint", help="where goals are served; default ipc://RUNTIME/runner.sock")
    sim.add_argument("--arbiter", help="the arbiter's endpoint")
    sim.add_argument("--no-arbiter", action="store_true", help="nobody arbitrates: mark no uses")
    sim.add_argument(
        "--sidecar", action="append", default=[], metavar="RSKILL=ENDPOINT",
        help="where a policy's sidecar is; default ipc://RUNTIME/NAME.sock, NAME being what follows the first - of the skill's name",
    )  # fmt: skip
    sim.add_argument("--max-seconds", type=float, help="stop by itself after so many seconds")
    sim.add_argument("--log-level", default="info", choices=("debug", "info", "warning", "error"))
    args = parser.parse_args(argv)
    if args.rate < 0 or (args.max_seconds is not None and args.max_seconds <= 0):
        parser.error("--rate must be 0 or more, --max-seconds positive")
    return args


def main(argv: list[str] | None = None) -> int:
    """Console script `vram-runner`."""
    args = parse(argv)
    logging.basicConfig(
        level=args.log_level.upper(), stream=sys.stderr, format="%(asctime)s runner %(levelname)s %(message)s"
    )
    logging.getLogger("OpenGL").setLevel(logging.WARNING)  # it announces an accelerator that nobody needs
    try:
        return asyncio.run(run_sim(args))
    except VramError as error:
        print(f"vram-runner: {error}", file=sys.stderr)
        return 2 if isinstance(error, ConfigError) else 1


def sidecar_endpoint(rskill_id: str, given: Mapping[str, str], environ: Mapping[str, str]) -> str:
    """Where the policy of a skill is served: as given, else by its name, `OWNER/so101-grab` → `grab`."""
    repository = rskill_id.rpartition("/")[2]
    _, dash, rest = repository.partition("-")
    return given.get(rskill_id) or program_endpoint(rest if dash else repository, environ, os.getuid())


def sidecars_given(flags: list[str]) -> dict[str, str]:
    """`RSKILL=ENDPOINT` flags as a map. Raises ConfigError."""
    pairs = [flag.partition("=") for flag in flags]
    if wrong := [flag for flag, (name, _, where) in zip(flags, pairs, strict=True) if not name or not where]:
        raise ConfigError(f"--sidecar {wrong[0]} is not of the form RSKILL=ENDPOINT")
    return {name: where for name, _, where in pairs}


async def run_sim(args: argparse.Namespace) -> int:
    """Build everything, serve until a signal, `shutdown` or `--max-seconds`, end in order."""
    from pydantic import ValidationError

    from clients.sidecar.policy import PolicyClient
    from runner.catalogue import Catalogue, Maker, read_manifests
    from runner.clock import SystemClock
    from runner.control import ControlThread
    from runner.goals import GoalServer
    from runner.protocols import DeadlinePolicy, Skill
    from runner.recorder import Recorder
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
            lambda: env,
            cameras=tuple(name for name in OBSERVATION_CAMERAS if name in scene.cameras),
            seed=args.seed,
            rate_hz=args.rate,
            deadline_policy=DeadlinePolicy(args.deadline_policy),
            clock=clock,
            video_camera=VIDEO_CAMERA,
            video_every=VIDEO_EVERY,
        )
        control = await stack.enter_async_context(ControlThread(runner))
        await asyncio.to_thread(warm_up)
        await control.call(lambda: None)  # the scene stands and the cameras have rendered: ready means ready
        server = GoalServer(
            args.endpoint or program_endpoint("runner", os.environ, os.getuid()),
            control,
            runner,
            Catalogue(manifests, makers),
            clock,
            ground_truth=lambda: truth_as_wire(env),
            on_bound=lambda: setattr(
                runner, "recorder", recorder
            ),  # not before: a second runner must not touch the first's video
            identity={
                "robot": "so101-mobile",
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
    return 1 if control.ended.exception() is not None else 0


def warm_up() -> None:
    """The first picture would otherwise wait for OpenCV's import."""
    import cv2
    import numpy as np

    cv2.setNumThreads(1)
    frames.encode(np.zeros((8, 8, 3), dtype=np.uint8), "png")


async def connect_arbiter(endpoint: str | None, stack: contextlib.AsyncExitStack) -> Any:
    """A plain client of the arbiter. A robot does not start half-safe: an arbiter that is missing is an error, said at once."""
    from clients.aio import ArbiterClient

    try:
        return await stack.enter_async_context(ArbiterClient(endpoint, name="runner"))
    except ArbiterUnreachable as error:
        raise ArbiterUnreachable(
            error.message, hint="start `vram-arbiter` first, or run with --no-arbiter", details=error.details
        ) from error


def default_skills() -> Path:
    """Folder of the shipped manifests. Raises ConfigError where there is none."""
    folder = configs_folder(os.environ) / "rskills"
    if not folder.is_dir():
        raise ConfigError(
            f"no skills in {folder}", hint="name some with --skills, or set VRAM_ARBITER_CONFIGS"
        )
    return folder


def install_signals(stopping: asyncio.Event) -> None:
    """The first SIGTERM or SIGINT ends in order (the video is finished); a second one ends at once."""
    loop = asyncio.get_running_loop()

    def stop(number: signal.Signals) -> None:
        log.info("%s: ending", number.name)
        loop.remove_signal_handler(number)
        stopping.set()

    for number in (signal.SIGTERM, signal.SIGINT):
        loop.add_signal_handler(number, stop, number)


if __name__ == "__main__":
    sys.exit(main())
