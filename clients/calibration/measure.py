"""Run a program under observation: a thread reads the GPU, the program goes through its phases."""

import asyncio
import os
import sys
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.clients.calibration.basis import Basis, Pace, find_basis, need_baseline
from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.calibration.program import ObservedProgram
from vram_arbiter.clients.calibration.requests import asking, client_type
from vram_arbiter.clients.calibration.sampler import OwnBytes, Sampler
from vram_arbiter.clients.calibration.series import REST_BYTES, Figures, of_life
from vram_arbiter.clients.sidecar.spawn import SpawnSpec
from vram_arbiter.schemas.errors import CalibrationFailed
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.sizes import format_bytes

SIDECAR = (sys.executable, "-m", "vram_arbiter.sidecars")
LOAD_S = 1800.0
"""A large model from a cold disk."""


@dataclass(frozen=True, slots=True)
class Measured:
    """Figures, and how they were made."""

    figures: Figures
    basis: Basis
    rate_hz: float
    requests: int


async def measure_program(
    gpu: Gpu, pace: Pace, command: Sequence[str], seconds: float | None, say: Callable[[str], None]
) -> Measured:
    """Observe a program from its start to its end; after `seconds` it is ended.

    Raises CalibrationFailed with its exit code and last lines where it fails, or without any bytes.
    """
    basis = await find_basis(gpu, pace)
    say(f"an empty context has {format_bytes(basis.context_bytes)}; starting {command[0]}")
    with Sampler(OwnBytes(gpu, basis), pace.period_s) as sampler:
        program = await ObservedProgram.start(command, {**os.environ, **gpu.environ})
        try:
            async with asyncio.timeout(seconds):
                await program.ended()
        except TimeoutError:
            say(f"ending it after {seconds:g} s")
        else:
            program.check()
        finally:
            await program.end()
        after = await _settled(sampler, pace, gone=True)
    if not basis.listed:
        await need_baseline(gpu, basis.baseline_bytes, pace)
    figures = of_life(sampler.series, basis.context_bytes, after)
    if figures is None:
        raise _no_bytes(gpu, command[0], program.tail())
    return Measured(figures, basis, sampler.series.rate_hz, 0)


@dataclass(frozen=True, slots=True)
class Asked:
    """What a model is asked. `pictures`: a folder of them (None: noise); `prompt`: in words (None:
    the manifest's)."""

    requests: int
    pictures: Path | None = None
    prompt: str | None = None


async def measure_model(
    gpu: Gpu,
    pace: Pace,
    manifest: RSkillManifest,
    arguments: Sequence[str],
    asked: Asked,
    say: Callable[[str], None],
    sidecar: Sequence[str] = SIDECAR,
) -> Measured:
    """Load a model in a sidecar of its own, ask it, unload it and end it.

    `sidecar` is its command, and `arguments` name the model for it. Raises the sidecar's typed
    errors, CalibrationFailed and ProbeFailed.
    """
    client_for = client_type(manifest)
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        endpoint = f"ipc://{folder}/calibrate.sock"
        argv = [
            *sidecar, "--name", "calibrate", "--no-arbiter", "--device", gpu.device,
            "--endpoint", endpoint, *arguments,
        ]  # fmt: skip
        spawn = SpawnSpec(argv, dict(gpu.environ), Path(folder) / "log")
        client = client_for(endpoint, spawn=spawn, timeout_s=LOAD_S)
        ask = asking(client, manifest, asked.pictures, asked.prompt)
        basis = await find_basis(gpu, pace)
        say(f"an empty context has {format_bytes(basis.context_bytes)}; loading {manifest.name}")
        with Sampler(OwnBytes(gpu, basis), pace.period_s) as sampler:
            try:
                await client.load()
                steady = await _settled(sampler, pace)
                if steady <= REST_BYTES:
                    raise _no_bytes(gpu, manifest.name, "")
                asked_s = sampler.clock()
                load_peak = sampler.series.peak(0.0, asked_s)
                say(f"resident with {format_bytes(steady)}; asking {asked.requests} times")
                for _ in range(asked.requests):
                    await ask()
                    sampler.check()
                await asyncio.sleep(2 * pace.period_s)  # a reading after the last answer
                inference_peak = sampler.series.peak(asked_s, sampler.clock())
                await client.unload()
                retained = await _settled(sampler, pace, gone=True)
                say(f"unloaded; {format_bytes(retained)} are left")
            finally:
                await client.close()
            after = await _settled(sampler, pace, gone=True)
    if not basis.listed:
        await need_baseline(gpu, basis.baseline_bytes, pace)
    figures = Figures(
        context=basis.context_bytes,
        load_peak=load_peak,
        steady=steady,
        inference_peak=inference_peak if asked.requests else None,
        retained=retained,
        after_exit=after,
    )
    return Measured(figures, basis, sampler.series.rate_hz, asked.requests)


async def _settled(sampler: Sampler, pace: Pace, *, gone: bool = False) -> int:
    """Return the program's bytes once they are at rest; `gone`: or all gone. Raises
    CalibrationFailed."""
    since_s = sampler.clock()
    deadline_s = since_s + pace.rest_s + pace.limit_s
    while (now_s := sampler.clock()) < deadline_s:
        sampler.check()
        series = sampler.series
        fresh = series.end_s > since_s
        rested = min(series.rested_s(), now_s - since_s) >= pace.rest_s
        if fresh and (rested or (gone and series.last <= REST_BYTES)):
            return series.last
        await asyncio.sleep(pace.period_s)
    raise CalibrationFailed(
        f"the program's bytes did not come to rest within {deadline_s - since_s:.0f} s",
        hint="if it works in the background, measure it with: vramctl calibrate -- COMMAND",
    )


def _no_bytes(gpu: Gpu, name: str, tail: str) -> CalibrationFailed:
    return CalibrationFailed(
        f"no bytes of {name} were seen on {gpu.name} ({gpu.uuid})",
        hint="does it run on the CPU, or on another GPU? see --device",
        details={"log": tail},
    )
