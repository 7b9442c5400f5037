"""`vramctl demo`: the loop *find → navigate → grab* with six real processes inside 8 GiB.

It starts the programs, watches the GPU, and judges by three witnesses: the simulator's ground
truth, the scene VLM, and the reasoner's own end. With `--arbiter off` the same programs run without
the arbiter and show the out-of-memory that the product exists for.
"""

import argparse
import asyncio
import contextlib
import json
import os
import shutil
import sys
import tempfile
import time
import uuid
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.demo_display import Display
from vram_arbiter.clients.cli.demo_report import (
    MemoryStory,
    draw_timeline,
    read_log,
    returned,
    summarise,
)
from vram_arbiter.clients.cli.programs import Child, Programs
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import RunnerUnreachable, SidecarUnavailable
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE, RUNTIME_VARIABLE
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.units import parse_bytes
from vram_arbiter.schemas.urls import HttpAddress, http_address

DESCRIPTIONS = {
    "demo": "Run find, navigate, grab on a simulated robot inside an 8 GiB GPU budget. Exits 0 if "
    "the demo shows what it promises (with the arbiter: completed without any out-of-memory, and "
    "the detector back on the GPU; without: an out-of-memory), 1 if not."
}
SEED_MAX = 2**31 - 1
DETECTOR, VLM, GRAB = "detector", "scene-vlm", "grab"
ROBOTS = {
    "so101-mobile": {DETECTOR: "so101-detector", VLM: "so101-scene-vlm", GRAB: "so101-grab"},
    "panda-mobile": {DETECTOR: "so101-detector", VLM: "panda-scene-vlm", GRAB: "panda-grab"},
}
"""Sidecars and their skills, by the robot of `vram-runner sim --robot`."""
NOTES = {
    "panda-mobile": "the grab is scripted: it has the contract and the footprint of "
    "pi05-robocasa365, and no model"
}
CLIENTS = {DETECTOR: DetectorClient, VLM: SceneVlmClient, GRAB: PolicyClient}
# the detector is resident between goals; the models of a goal leave when they are idle
IDLE = ["--idle-release-s", "5"]
RESIDENCY = {DETECTOR: ["--standby"], VLM: IDLE, GRAB: IDLE}
BUDGET = "8GiB"
# of the simulated GPU: a copy from ordinary host RAM over PCIe 4.0
COPY_BYTES_PER_S = 6_000_000_000
BOOT_S = 240.0
LOOP_S = (
    400.0  # it takes one or two minutes; a machine with other work on its cores has time as well
)
BACK_S = 90.0  # for the detector, once the reasoner has ended: idle seconds, and one load
SHOWN_S = 3.0  # watched on, so that the timeline shows it
POLL_S = 0.2


@dataclass(frozen=True, slots=True)
class Episode:
    """What is run: `gpu` is `nvml` or `fake:SIZE`; `http`: where a status page is served."""

    seed: int
    arbiter: bool
    gpu: str
    out: Path
    http: HttpAddress | None = None
    robot: str = "so101-mobile"

    @property
    def sidecars(self) -> Mapping[str, str]:
        return ROBOTS[self.robot]


@dataclass(slots=True)
class Watch:
    """What was seen while the loop ran."""

    start_s: float
    wall_offset_s: float  # wall clock minus monotonic clock
    events: list[JsonObject] = field(default_factory=list)
    measured: list[tuple[float, int]] = field(default_factory=list)
    capacity_bytes: int = 0
    detector_held: bool = False  # when it was last looked at


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "--quick",
        action="store_true",
        help="no robot: three stand-in programs take turns on a simulated GPU, in about 20 s and "
        "with the base install; no other option applies",
    )
    parser.add_argument(
        "--seed",
        type=arguments.count(0, SEED_MAX),
        default=0,
        help="which episode: objects, places, light (default: %(default)s)",
    )
    parser.add_argument(
        "--robot",
        choices=tuple(ROBOTS),
        default="so101-mobile",
        help="panda-mobile: a Panda at a kitchen counter, whose grab is scripted (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--arbiter",
        choices=("on", "off"),
        default="on",
        help="off: without it the same loop runs out of memory (default: %(default)s)",
    )
    parser.add_argument(
        "--gpu",
        default=f"fake:{BUDGET}",
        help="fake:SIZE, or nvml on a machine with an NVIDIA GPU (default: %(default)s)",
    )
    parser.add_argument(
        "--http",
        metavar="ADDRESS:PORT",
        type=_address,
        help="serve a status page of the arbiter meanwhile, e.g. on 9870",
    )
    parser.add_argument(
        "--out",
        type=Path,
        default=Path("out/demo"),
        help="folder for summary.json, timeline.png, episode.mp4 and logs (default: %(default)s)",
    )


def _address(text: str) -> HttpAddress:
    try:
        found = http_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error
    if not found.loopback or not found.port:
        raise argparse.ArgumentTypeError(f"expected a port of loopback such as 9870, got {found}")
    return found


def run(args: argparse.Namespace) -> int:
    """Run the demo. Returns 0 if it shows what it promises.

    With the arbiter: completed without an out-of-memory, and the detector is back on the GPU.
    Without: an out-of-memory.
    """
    if args.quick:
        from vram_arbiter.clients.cli import demo_quick

        options = ("seed", "robot", "arbiter", "gpu", "http", "out")
        if any(getattr(args, name) != args.parser.get_default(name) for name in options):
            args.parser.error("--quick takes no other option")
        return demo_quick.run()
    if args.gpu != "nvml" and not args.gpu.startswith("fake:"):
        args.parser.error(f"--gpu: expected nvml or fake:SIZE, got {args.gpu!r}")
    arbiter = args.arbiter == "on"
    if args.gpu == "nvml" and not arbiter:
        args.parser.error(
            "without the arbiter no program reads a real GPU; use --gpu fake:8GiB with --arbiter "
            "off"
        )
    if args.http is not None and not arbiter:
        args.parser.error("the status page shows an arbiter: leave out --http or --arbiter off")
    packages = ("torch", "lerobot", "transformers", "mujoco", "cv2", "matplotlib")
    need("the demo", *packages, extra="all")
    out: Path = args.out
    summary = asyncio.run(_demo(Episode(args.seed, arbiter, args.gpu, out, args.http, args.robot)))
    print(json.dumps({key: value for key, value in summary.items() if key != "loads"}, indent=2))
    print(f"written: {out}/summary.json, {out}/timeline.png, {out}/episode.mp4")
    oom = summary["oom_events"] > 0
    shown = summary["completed"] and summary["detector_resident"] and not oom
    return 0 if (shown if arbiter else oom) else 1


async def _demo(what: Episode) -> JsonObject:
    shutil.rmtree(what.out, ignore_errors=True)
    (what.out / "logs").mkdir(parents=True)
    runtime = Path(
        tempfile.mkdtemp(prefix="vram-demo-")
    )  # short: ipc paths have at most 107 characters
    try:
        programs = Programs(
            what.out / "logs",
            {
                RUNTIME_VARIABLE: str(runtime),
                ENDPOINT_VARIABLE: f"ipc://{runtime}/arbiter.sock",  # not the machine's own
                "HF_HUB_OFFLINE": "1",
                "OMP_NUM_THREADS": "1",
            },
        )
        try:
            return await _episode(programs, runtime, what)
        finally:
            await programs.stop_all()
    finally:
        shutil.rmtree(runtime, ignore_errors=True)


async def _episode(programs: Programs, runtime: Path, what: Episode) -> JsonObject:
    gpu, out, arbiter = what.gpu, what.out, what.arbiter
    folder = runtime / "fakegpu"
    if gpu.startswith("fake:"):
        make_gpu(folder, parse_bytes(gpu.removeprefix("fake:")))
    watch = Watch(time.monotonic(), time.time() - time.monotonic())
    async with contextlib.AsyncExitStack() as stack:
        runner = await stack.enter_async_context(RunnerClient(f"ipc://{runtime}/runner.sock"))
        client = await boot(programs, runtime, runner, stack, what)
        target = (await runner.ground_truth())["target"]
        task = f"grab the {target}"
        watch.start_s = time.monotonic()
        display = Display()
        display.say(f"{task}{'' if arbiter else ', without an arbiter'}")
        result_file = out / "reasoner.json"
        reasoner = await programs.start(
            "reasoner", "reasoner", "--task", task, "--result", str(result_file.resolve())
        )
        await _watch(programs, reasoner, client, display, watch)
        truth = await runner.ground_truth()
        seconds = time.monotonic() - watch.start_s
        await programs.stop("runner")  # finishes the video
        if client is not None:
            await _until_back(client, display, watch)
    story = _story(folder, gpu, programs.pids(), watch)
    outcome = (
        json.loads(result_file.read_text())
        if result_file.exists()
        else {"reason": f"no result: {reasoner.tail()}"}
    )
    capacity = watch.capacity_bytes or parse_bytes(gpu.removeprefix("fake:"))
    summary = summarise(
        seed=what.seed, arbiter=arbiter, task=task, story=story, capacity_bytes=capacity,
        events=watch.events, reasoner=outcome, truth=truth,
        target=target, seconds=seconds, detector_resident=watch.detector_held,
    )  # fmt: skip
    (out / "summary.json").write_text(json.dumps(summary, indent=2) + "\n")
    title = (
        f"{task}: {'completed' if summary['completed'] else 'not completed'}, "
        f"{summary['oom_events']} out-of-memory"
    )
    draw_timeline(
        out / "timeline.png", story, capacity, watch.events,
        watch.measured if gpu == "nvml" else (), start_s=watch.start_s,
        end_s=max((at_s for at_s, _ in watch.measured), default=0.0),
        wall_offset_s=watch.wall_offset_s,
        title=title + ("" if arbiter else " (no arbiter)"),
    )  # fmt: skip
    return summary


def make_gpu(folder: Path, capacity_bytes: int) -> None:
    """Make the simulated GPU before a program needs it: there may be no arbiter that makes one."""
    boot_id = procfs.boot_id()
    folder.mkdir()
    config = fakegpu.FakeGpuConfig(
        uuid=f"GPU-fake-{uuid.uuid4()}",
        capacity_bytes=capacity_bytes,
        boot_id=boot_id,
        throttle_bytes_per_s=COPY_BYTES_PER_S,
    )
    (folder / fakegpu.GPU_FILE).write_text(fakegpu.dump_config(config))


async def boot(
    programs: Programs,
    runtime: Path,
    runner: RunnerClient,
    stack: contextlib.AsyncExitStack,
    what: Episode,
) -> AsyncClient | None:
    """Start everything and wait until each answers. The arbiter's client, if there is an
    arbiter."""
    gpu, arbiter = what.gpu, what.arbiter
    print(
        f"starting {'the arbiter, ' if arbiter else ''}{len(what.sidecars)} sidecars and the "
        "runner (imports take a while) …"
    )
    if what.robot in NOTES:
        print(f"note: {NOTES[what.robot]}")
    without = [] if arbiter else ["--no-arbiter"]
    client = None
    if arbiter:
        source = gpu if gpu == "nvml" else f"fake:{runtime}/fakegpu"
        config = runtime / "arbiter.yaml"
        # a larger real GPU is budgeted like the small one
        config.write_text(f'gpu:\n  capacity_bytes: {{"0": {BUDGET}}}\n')
        page = [] if what.http is None else ["--http", str(what.http)]
        await programs.start("arbiter", "arbiter", "--gpu", source, "--config", str(config), *page)
        client = await stack.enter_async_context(_arbiter_client(runtime))
        top = f"{_vramctl()} top --endpoint ipc://{runtime}/arbiter.sock"
        print(f"live in another terminal: {top}")
        if what.http is not None:
            print(f"status page: http://{what.http}")
    device = "cuda" if gpu == "nvml" else f"fake:{runtime}/fakegpu"
    for name, rskill in what.sidecars.items():
        manifest = str(configs_folder(os.environ) / "rskills" / rskill / "rskill.yaml")
        stays = without or RESIDENCY[name]
        await programs.start(
            name, "sidecars", "--name", name, "--rskill", manifest, "--device", device, *stays
        )
    video = str((what.out / "episode.mp4").resolve())
    await programs.start(
        "runner", "runner", "sim", "--robot", what.robot, "--seed", str(what.seed),
        "--video", video, *without,
    )  # fmt: skip
    sidecars = [CLIENTS[name](f"ipc://{runtime}/{name}.sock") for name in what.sidecars]
    async with asyncio.timeout(BOOT_S):
        for sidecar in sidecars:
            async with sidecar:
                await _until_up(programs, sidecar.ping)
        await _until_up(programs, runner.ping)
    return client


def _vramctl() -> str:
    """Return this program as it is typed here: a clone's environment is seldom on PATH."""
    started = Path(sys.argv[0])
    if started.name != "vramctl":
        return f"{sys.executable} -m vram_arbiter.clients"
    found = shutil.which("vramctl")
    return "vramctl" if found is not None and started.samefile(found) else str(started)


def _arbiter_client(runtime: Path) -> AsyncClient:
    return AsyncClient(
        "demo", endpoint=f"ipc://{runtime}/arbiter.sock", role="observer", connect_timeout_s=30.0
    )


async def _until_up(programs: Programs, ping: Any) -> None:
    while True:
        programs.check()
        try:
            await ping()
        except (SidecarUnavailable, RunnerUnreachable):
            await asyncio.sleep(POLL_S)
        else:
            return


async def _watch(
    programs: Programs,
    reasoner: Child,
    client: AsyncClient | None,
    display: Display,
    watch: Watch,
) -> None:
    """Follow the loop until the reasoner ends or the time is up."""
    ended = asyncio.create_task(reasoner.process.wait())
    try:
        while not ended.done() and time.monotonic() - watch.start_s < LOOP_S:
            await asyncio.wait([ended], timeout=POLL_S)
            await _look(client, display, watch)
            display.robot(_last_line(reasoner), time.monotonic() - watch.start_s)
            _check_others(programs, reasoner)
        if not ended.done():
            display.say(f"no result after {LOOP_S:.0f} s: stopping the reasoner")
            await programs.stop(reasoner.name)
        await _look(client, display, watch)
    finally:
        ended.cancel()


async def _until_back(client: AsyncClient, display: Display, watch: Watch) -> None:
    """Wait until the detector, whose lease is on standby, is resident again: nothing calls it."""
    deadline_s = time.monotonic() + BACK_S
    while not watch.detector_held and time.monotonic() < deadline_s:
        await asyncio.sleep(POLL_S)
        await _look(client, display, watch)
    if (back := returned(watch.events)) is not None:
        await asyncio.sleep(SHOWN_S)
        await _look(client, display, watch)
        display.say(f"the detector is back by itself, {back['after_s']} s after the grab")
    elif not watch.detector_held:
        display.say(f"the detector is not back after {BACK_S:.0f} s")


async def _look(client: AsyncClient | None, display: Display, watch: Watch) -> None:
    if client is None:
        return
    status = to_map(await client.status())
    gpu = status["gpus"][0]
    watch.measured.append((time.monotonic(), gpu["measured_used_bytes"] or 0))
    watch.capacity_bytes = gpu["capacity_bytes"]
    leases = {lease["consumer"]: lease["state"] for lease in status["leases"]}
    watch.detector_held = leases.get("detector") == "held"
    after = watch.events[-1]["seq"] if watch.events else 0
    for event in (await client.history(after=after)).events:
        watch.events.append(dict(event))
        display.event(event, event["at_wall_s"] - watch.wall_offset_s - watch.start_s)


def _check_others(programs: Programs, reasoner: Child) -> None:
    if reasoner.process.returncode is None:
        programs.check()


def _last_line(program: Child) -> str:
    lines = program.log.read_text(errors="replace").splitlines()
    return lines[-1].partition("reasoner.loop ")[2] if lines else ""


def _story(folder: Path, gpu: str, names: Mapping[int, str], watch: Watch) -> MemoryStory:
    if gpu == "nvml":
        refused = (event["at_wall_s"] for event in watch.events if event["kind"] == "oom")
        peak_bytes = max((used for _, used in watch.measured), default=0)
        return MemoryStory((), peak_bytes, tuple(at_s - watch.wall_offset_s for at_s in refused))
    return read_log((folder / fakegpu.LOG_FILE).read_text(), names)
