"""Time from the end of the last drive to the first control step of the grab, with and without the
hint that the grab follows.

    python -m tests.bench.bench_prepare [--rounds 5]

Real arbiter, simulator, detector and grab sidecars. The grab stands for a model of 4.3 GB, whose
weights come from a disk of 2 GB/s and reach the simulated GPU at 6 GB/s, as in the demo; the
detector is resident and has to leave. Before each round the grab's weights are in neither memory;
then the robot turns for some seconds, the hint is given at the beginning of the
turn or not at all, and a goal of one control step follows. Prints a table
and writes `out/bench/prepare.json`.
"""

import argparse
import asyncio
import dataclasses
import json
import statistics
import sys
import time
from contextlib import AsyncExitStack
from pathlib import Path

from tests.bench.bench_runner import (
    BOOT_S,
    GRAB,
    NAVIGATE,
    NO_HOLD,
    SKILLS,
    _goal,
    _program,
    _until_up,
)
from tests.bench.harness import SHIPPED, arbiter
from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.testing.gpu import FakeGpu

COPY_BYTES_PER_S = 6_000_000_000
TURN_RAD = 2.0
HOST_RAM = "host:\n  park_budget_bytes: 16GiB\n"


@dataclasses.dataclass(slots=True)
class Row:
    """Seconds from the end of the drive to the end of the grab's first control step, by round."""

    hint: bool
    seconds: list[float]
    drive_s: float


def _words(daemon: ArbiterProcess, name: str) -> list[str]:
    """A sidecar as the demo starts it, with the measured footprint of what it stands for."""
    manifest = ROOT / "configs" / "rskills" / SKILLS[name] / "rskill.yaml"
    return [
        "vram_arbiter.sidecars", "--name", name, "--rskill", str(manifest),
        "--device", f"fake:{daemon.gpu_folder}", "--min-residency-s", "0",
    ]  # fmt: skip


async def _round(
    hint: bool,
    daemon: ArbiterProcess,
    runner: RunnerClient,
    detector: DetectorClient,
    grab: PolicyClient,
    arbiter_client: AsyncClient,
    way: float,
) -> tuple[float, float]:
    """Return seconds to the first step, and of the drive."""
    await grab.unload()
    while any(lease.consumer == "grab" for lease in (await arbiter_client.status()).leases):
        await asyncio.sleep(0.05)
    await detector.load(timeout_s=BOOT_S)
    began = time.perf_counter()
    goal = await runner.send_goal(NAVIGATE, goal_params={"turn_rad": way})
    if hint:
        await Hints(daemon.endpoint).follows(GRAB)
    result = await goal.result(BOOT_S)
    if result["status"] != "succeeded":
        raise RuntimeError(f"the robot does not drive: {result}")
    drive_s = time.perf_counter() - began
    return await _goal(runner) / 1e6, drive_s


async def _measure(daemon: ArbiterProcess, rounds: int) -> list[Row]:
    rows = [Row(False, [], 0.0), Row(True, [], 0.0)]
    async with AsyncExitStack() as stack:
        sidecars = [
            stack.enter_context(_program(daemon, name, _words(daemon, name))) for name in SKILLS
        ]
        detector = await stack.enter_async_context(
            DetectorClient(f"ipc://{daemon.runtime}/detector.sock")
        )
        grab = await stack.enter_async_context(PolicyClient(f"ipc://{daemon.runtime}/grab.sock"))
        runner = await stack.enter_async_context(
            RunnerClient(f"ipc://{daemon.runtime}/runner.sock")
        )
        client = await stack.enter_async_context(
            AsyncClient("bench", endpoint=daemon.endpoint, role="observer")
        )
        process = stack.enter_context(
            _program(daemon, "runner", ["vram_arbiter.runner", "sim", "--seed", "1"])
        )
        for ping in (runner.ping, detector.ping, grab.ping):
            await _until_up(ping, [process, *sidecars])
        await grab.load(timeout_s=BOOT_S)  # imports are no part of it
        way = TURN_RAD
        for _ in range(rounds):
            for row in rows:
                taken, row.drive_s = await _round(
                    row.hint, daemon, runner, detector, grab, client, way
                )
                row.seconds.append(taken)
                way = -way
    return rows


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--rounds", type=int, default=5)
    parser.add_argument("--out", type=Path, default=Path("out/bench/prepare.json"))
    options = parser.parse_args()
    with arbiter(SHIPPED + NO_HOLD + HOST_RAM) as daemon:
        FakeGpu(daemon.gpu_folder).edit(throttle_bytes_per_s=COPY_BYTES_PER_S)
        rows = asyncio.run(_measure(daemon, options.rounds))
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps([dataclasses.asdict(row) for row in rows], indent=1) + "\n")
    print(
        "| hint | drive | from the drive to the first step, median (range) |\n| --- | --- | --- |"
    )
    for row in rows:
        low, high = min(row.seconds), max(row.seconds)
        print(
            f"| {'yes' if row.hint else 'no'} | {row.drive_s:.1f} s | "
            f"{statistics.median(row.seconds):.2f} s ({low:.2f} to {high:.2f}) |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
