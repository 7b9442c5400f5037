"""Record of a program's bytes while it runs, and the figures that it gives.

Bytes are those of the processes below this one where the driver lists bytes by process, else the
growth of the GPU's used bytes on a GPU that is otherwise at rest. An empty context, measured first,
shows which.
"""

import asyncio
import os
import sys
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from itertools import accumulate, pairwise

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.foreign.program import adopt_orphans, is_below
from vram_arbiter.schemas.defaults import MIB, VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import CalibrationFailed, ProbeFailed, VramError
from vram_arbiter.schemas.sizes import format_bytes

CONTEXT = (sys.executable, "-m", "vram_arbiter.clients.calibration.context")
REST_BYTES = MIB
"""Readings that differ by no more are at rest."""
LAST_PART = 0.25
"""Share of a program's time on the GPU, at its end, in which it is taken to do its work."""

type Series = Sequence[tuple[float, int]]
"""(monotonic time of the reading's end, bytes of the program); of equal ones in a row the first and
the last"""


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured, in bytes. Each but `context` is of the whole process tree.

    `inference_peak` None: nothing was asked. `retained` is left after an unload, `after_exit` after
    the program's end.
    """

    context: int
    load_peak: int
    steady: int
    inference_peak: int | None
    retained: int | None
    after_exit: int

    @property
    def freed(self) -> int:
        """What the unload, or for a program without one its end, gave back."""
        return self.steady - (self.after_exit if self.retained is None else self.retained)


@dataclass(slots=True)
class Record:
    """`begin`, run the program, `end`; then `figures`. Readings are made by a thread.

    `rest_s` is longer than drivers take to return memory (0.5 to 1.5 s).
    """

    gpu: Gpu
    rate_hz: float = 50.0
    rest_s: float = 2.0
    limit_s: float = VERIFY_TIMEOUT_S
    listed: bool = True
    context_bytes: int = 0
    baseline_bytes: int = 0
    series: list[tuple[float, int]] = field(default_factory=list)
    _readings: int = 0
    _error: VramError | None = None
    _over: threading.Event = field(default_factory=threading.Event)
    _thread: threading.Thread | None = None

    async def begin(self) -> None:
        """Measure an empty context, and start the readings. Raises CalibrationFailed,
        ProbeFailed."""
        adopt_orphans()  # a process stays below this one when its parent ends
        self.series.append((time.monotonic(), 0))
        self._thread = threading.Thread(target=self._run, name="readings", daemon=True)
        self.baseline_bytes = self.gpu.read().used_bytes
        self._thread.start()
        process = await asyncio.create_subprocess_exec(
            *CONTEXT, self.gpu.device, env={**os.environ, **self.gpu.environ},
            stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        )  # fmt: skip
        assert process.stdin is not None, "a pipe"
        assert process.stdout is not None, "a pipe"
        try:
            if await process.stdout.readline() != b"ready\n":
                raise CalibrationFailed(
                    f"no context can be created on {self.gpu.name}: see above",
                    hint="check that CUDA programs run on it; see nvidia-smi",
                )
            self.context_bytes = await self._rest()
            if self.context_bytes <= REST_BYTES:
                self.listed = False
                self.context_bytes = await self._rest()
        finally:
            process.stdin.close()
            await process.wait()
        await self._gone()
        self.series[:] = self.series[-1:]
        self._readings = 0

    async def end(self) -> None:
        """Wait until the program's bytes are at rest after its end. Raises CalibrationFailed."""
        await self._gone()
        self._over.set()

    def figures(self, marks: Mapping[str, float]) -> Figures | None:
        """Return the figures; None where no bytes were seen. `marks`: times that a model's program
        has told (`model`); without them all is concluded from the series."""
        after = self.series[-1][1]
        if marks:
            return of_marks(self.series, marks, self.context_bytes, after)
        return of_life(self.series, self.context_bytes, after)

    @property
    def readings_hz(self) -> float:
        """Readings per second, as they were really made."""
        span_s = self.series[-1][0] - self.series[0][0]
        return self._readings / span_s if span_s > 0 else 0.0

    def _run(self) -> None:
        while not self._over.wait(1 / self.rate_hz):
            try:
                count = self._own()
            except VramError as error:
                self._error = error
                return
            add(self.series, time.monotonic(), count)
            self._readings += 1

    def _own(self) -> int:
        reading = self.gpu.read()
        if not self.listed:
            return max(0, reading.used_bytes - self.baseline_bytes)
        if reading.processes is None and self.context_bytes:
            raise ProbeFailed(
                "the driver stopped to list processes in the middle of the measurement",
                hint="see nvidia-smi and dmesg",
            )
        own = (reading.processes or {}).items()
        return sum(count for pid, count in own if is_below(pid, os.getpid()))

    async def _rest(self) -> int:
        """Return the bytes once they have not changed for `rest_s`, from now on."""
        since_s = time.monotonic()
        while time.monotonic() < since_s + self.rest_s + self.limit_s:
            await asyncio.sleep(1 / self.rate_hz)
            if self._error is not None:
                raise self._error
            late = [count for at_s, count in self.series if at_s > since_s][-1:]
            from_s = max(since_s, time.monotonic() - self.rest_s)
            rested = [count for at_s, count in self.series if at_s >= from_s]
            still = rested and max(rested) - min(rested) <= REST_BYTES
            if late and still and time.monotonic() - since_s >= self.rest_s:
                return late[0]
        patience_s = self.rest_s + self.limit_s
        raise CalibrationFailed(
            f"bytes on {self.gpu.name} did not come to rest within {patience_s:.0f} s",
            hint="end other programs on it: where the driver lists no bytes by process, they count",
        )

    async def _gone(self) -> None:
        """Wait until the bytes are at rest after an end; a total has to be back where it was."""
        left = await self._rest()
        if not self.listed and left > VERIFY_TOLERANCE_BYTES:
            raise CalibrationFailed(
                f"{format_bytes(left)} more than before are in use on {self.gpu.name} after the "
                "measurement: another program used it meanwhile",
                hint="the driver does not list bytes by process here, so nothing else may use it",
            )


def add(series: list[tuple[float, int]], at_s: float, count: int) -> None:
    """Add a reading: a program may run for days, and most of them are equal."""
    if len(series) > 1 and series[-2][1] == series[-1][1] == count:
        series[-1] = (at_s, count)
    else:
        series.append((at_s, count))


def of_life(series: Series, context: int, after_exit: int) -> Figures | None:
    """Return the figures of a program that ran from its start to its end; None: no bytes were seen.

    Nothing tells when such a program has loaded: its peak is that of the load, and the last part of
    its time on the GPU is taken for its work.
    """
    shown = [(at_s, count) for at_s, count in series if count > REST_BYTES]
    if not shown:
        return None
    (from_s, _), (to_s, _) = shown[0], shown[-1]
    begin_s = to_s - (to_s - from_s) * LAST_PART
    late = {shown[-1][1]: 0.0}  # seconds by bytes
    for (at_s, count), (next_s, _) in pairwise(series):
        if count > REST_BYTES and begin_s < next_s <= to_s:
            late[count] = late.get(count, 0.0) + next_s - max(at_s, begin_s)
    peak = max(count for _, count in shown)
    return Figures(context, peak, _median(late), max(late), None, after_exit)


def _median(seconds: Mapping[int, float]) -> int:
    """Return the bytes that were not exceeded for half of the time."""
    ordered = sorted(seconds)
    sums = list(accumulate(seconds[count] for count in ordered))
    return next(
        count for count, so_far in zip(ordered, sums, strict=True) if so_far >= sums[-1] / 2
    )


def of_marks(
    series: Series, marks: Mapping[str, float], context: int, after_exit: int
) -> Figures | None:
    """Return the figures of a model: it rested until `asked`, answered until `answered`, and was
    unloaded until `unloaded`. None: no bytes were seen."""

    def until(mark: str) -> list[int]:
        return [count for at_s, count in series if at_s <= marks[mark]]

    loading = until("asked")
    if not loading or loading[-1] <= REST_BYTES:
        return None
    answering = until("answered")[len(loading) - 1 :]
    inference_peak = max(answering) if marks["requests"] else None
    left = until("unloaded")[-1]
    return Figures(context, max(loading), loading[-1], inference_peak, left, after_exit)
