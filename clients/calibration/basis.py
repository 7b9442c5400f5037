"""What can be seen on a GPU: bytes by process, or only the GPU's total; learned from a context.

Bytes are those of the program's process tree where the driver lists bytes by process, else the
growth of the GPU's used bytes on a GPU that is otherwise at rest.
"""

import asyncio
import contextlib
import os
import sys
import time
from collections.abc import AsyncIterator, Callable
from dataclasses import dataclass

from vram_arbiter.clients.calibration.gpu import Gpu, Reading
from vram_arbiter.clients.calibration.series import Series
from vram_arbiter.schemas.defaults import VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import CalibrationFailed
from vram_arbiter.schemas.sizes import format_bytes

CONTEXT = (sys.executable, "-m", "vram_arbiter.clients.calibration.context")
START_S = 60.0


@dataclass(frozen=True, slots=True)
class Pace:
    """How often the GPU is read, and how long bytes must be unchanged to be at rest.

    `rest_s` is longer than drivers take to return memory (0.5 to 1.5 s). What is not at rest within
    `limit_s` more never is.
    """

    rate_hz: float = 50.0
    rest_s: float = 2.0
    limit_s: float = VERIFY_TIMEOUT_S

    @property
    def period_s(self) -> float:
        return 1 / self.rate_hz


@dataclass(frozen=True, slots=True)
class Basis:
    """What can be seen on this GPU. `listed`: bytes by process; else `baseline_bytes` are in use
    without the program."""

    listed: bool
    context_bytes: int
    baseline_bytes: int


async def find_basis(gpu: Gpu, pace: Pace) -> Basis:
    """Measure an empty context, and learn from it what the driver lists.

    Raises CalibrationFailed where neither the list nor the total can tell the program's bytes.
    """
    async with _context(gpu) as pid:
        listed = await _rest(lambda: _listed(gpu.read(), pid), pace)
    if listed:
        return Basis(listed=True, context_bytes=listed, baseline_bytes=0)
    baseline = await _used_at_rest(gpu, pace)
    async with _context(gpu):
        used = await _used_at_rest(gpu, pace)
    await need_baseline(gpu, baseline, pace)
    return Basis(listed=False, context_bytes=max(0, used - baseline), baseline_bytes=baseline)


@contextlib.asynccontextmanager
async def _context(gpu: Gpu) -> AsyncIterator[int]:
    """An empty context on the GPU; gives the pid of its process. Raises CalibrationFailed."""
    process = await asyncio.create_subprocess_exec(
        *CONTEXT, gpu.device,
        env={**os.environ, **gpu.environ}, start_new_session=True,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None, "a pipe"
    assert process.stdout is not None, "a pipe"
    assert process.stderr is not None, "a pipe"
    try:
        try:
            first = await asyncio.wait_for(process.stdout.readline(), START_S)
        except TimeoutError:
            raise CalibrationFailed(
                f"creating a context on {gpu.name} took more than {START_S:.0f} s",
                hint="see nvidia-smi and dmesg",
            ) from None
        if first != b"ready\n":
            said = (await process.stderr.read()).decode(errors="replace").strip()
            raise CalibrationFailed(
                f"no context can be created on {gpu.name}: {said}",
                hint="check that CUDA programs run on it; see nvidia-smi",
            )
        yield process.pid
        process.stdin.close()
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


def _listed(reading: Reading, pid: int) -> int:
    return (reading.processes or {}).get(pid, 0)


async def _used_at_rest(gpu: Gpu, pace: Pace) -> int:
    found = await _rest(lambda: gpu.read().used_bytes, pace)
    if found is None:
        raise CalibrationFailed(
            f"{gpu.name} is in use by other programs, and the driver does not list bytes by process"
            " here",
            hint="end those programs, or measure outside the container",
        )
    return found


async def need_baseline(gpu: Gpu, baseline_bytes: int, pace: Pace) -> None:
    """Wait until the used bytes are back where they were. Raises CalibrationFailed: then others
    used the GPU meanwhile."""
    most = baseline_bytes + VERIFY_TOLERANCE_BYTES
    deadline_s = time.monotonic() + pace.limit_s
    while True:
        used = gpu.read().used_bytes
        if used <= most or time.monotonic() > deadline_s:
            break
        await asyncio.sleep(pace.period_s)
    if abs(used - baseline_bytes) > VERIFY_TOLERANCE_BYTES:
        raise CalibrationFailed(
            f"{format_bytes(used)} are in use on {gpu.name} after the measurement, "
            f"{format_bytes(baseline_bytes)} were before: another program used it meanwhile",
            hint="the driver does not list bytes by process here, so nothing else may use the GPU",
        )


async def _rest(read: Callable[[], int], pace: Pace) -> int | None:
    """Return a value that has not changed for `rest_s`; None: it does not come to rest."""
    series = Series()
    deadline_s = time.monotonic() + pace.rest_s + pace.limit_s
    while time.monotonic() < deadline_s:
        series.add(time.monotonic(), read())
        if series.rested_s() >= pace.rest_s:
            return series.last
        await asyncio.sleep(pace.period_s)
    return None
