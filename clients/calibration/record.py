"""Record of a program's bytes while it runs, and the figures that it gives.

Bytes are those of the processes below this one where the driver lists bytes by process, else the
growth of the GPU's used bytes on a GPU that is otherwise at rest.
"""

import os
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.foreign.program import adopt_orphans, is_below
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import VramError

RATE_HZ = 50.0
NOISE_BYTES = MIB
"""Fewer are not a program's."""
LAST_PART = 0.25
"""Share of a program's time on the GPU, at its end, in which it is taken to do its work."""

type Series = Sequence[tuple[float, int]]
"""(monotonic time of the reading's end, bytes of the program); of equal ones in a row the first and
the last"""


@dataclass(frozen=True, slots=True)
class Figures:
    """What was measured, in bytes of the whole process tree.

    `inference_peak` None: nothing was asked. `retained` is left after an unload.
    """

    load_peak: int
    steady: int
    inference_peak: int | None = None
    retained: int | None = None


@dataclass(slots=True)
class Record:
    """`begin`, run the program, `end`; then `figures`. Readings are made by a thread."""

    gpu: Gpu
    rate_hz: float = RATE_HZ
    baseline_bytes: int = 0
    own: list[tuple[float, int]] = field(default_factory=list)
    grown: list[tuple[float, int]] = field(default_factory=list)
    _unlisted: bool = False
    _error: VramError | None = None
    _over: threading.Event = field(default_factory=threading.Event)

    @property
    def listed(self) -> bool:
        """Whether the driver lists the program's bytes. In a container it may list none at all."""
        return not self._unlisted and max(count for _, count in self.own) > NOISE_BYTES

    def begin(self) -> None:
        """Start the readings. Raises ProbeFailed."""
        adopt_orphans()  # a process stays below this one when its parent ends
        self.baseline_bytes = self.gpu.read().used_bytes
        self._add()
        threading.Thread(target=self._run, name="readings", daemon=True).start()

    def end(self) -> None:
        """Stop the readings. Raises ProbeFailed where one failed."""
        self._over.set()
        if self._error is not None:
            raise self._error

    def figures(self, marks: Mapping[str, float]) -> Figures | None:
        """Return the figures; None where no bytes were seen. `marks`: times that a model's program
        has told (`model`); without them all is concluded from the series."""
        series = self.own if self.listed else self.grown
        return of_marks(series, marks) if marks else of_life(series)

    def _run(self) -> None:
        try:
            while not self._over.wait(1 / self.rate_hz):
                self._add()
        except VramError as error:
            self._error = error

    def _add(self) -> None:
        reading = self.gpu.read()
        self._unlisted |= reading.processes is None
        own = (reading.processes or {}).items()
        mine = sum(count for pid, count in own if is_below(pid, os.getpid()))
        add(self.own, time.monotonic(), mine)
        add(self.grown, time.monotonic(), max(0, reading.used_bytes - self.baseline_bytes))


def add(series: list[tuple[float, int]], at_s: float, count: int) -> None:
    """Add a reading: a program may run for days, and most of them are equal."""
    if len(series) > 1 and series[-2][1] == series[-1][1] == count:
        series[-1] = (at_s, count)
    else:
        series.append((at_s, count))


def of_life(series: Series) -> Figures | None:
    """Return the figures of a program that ran from its start to its end; None: no bytes were seen.

    Nothing tells when such a program has loaded: its peak is that of the load, and the last part of
    its time on the GPU is taken for its work.
    """
    shown = [(at_s, count) for at_s, count in series if count > NOISE_BYTES]
    if not shown:
        return None
    (from_s, _), (to_s, _) = shown[0], shown[-1]
    begin_s = to_s - (to_s - from_s) * LAST_PART
    late = [count for at_s, count in shown if at_s >= begin_s]
    return Figures(max(count for _, count in shown), max(late))


def of_marks(series: Series, marks: Mapping[str, float]) -> Figures | None:
    """Return the figures of a model: it rested until `asked`, answered until `answered`, and was
    unloaded until `unloaded`. None: no bytes were seen."""

    def until(mark: str) -> list[int]:
        return [count for at_s, count in series if at_s <= marks[mark]]

    loading = until("asked")
    if not loading or loading[-1] <= NOISE_BYTES:
        return None
    answering = until("answered")[len(loading) - 1 :]
    asked = max(answering) if marks["requests"] else None
    return Figures(max(loading), loading[-1], asked, until("unloaded")[-1])
