"""Readings of a program's bytes while it runs, made by a thread."""

import os
import threading
import time
from collections.abc import Callable

from vram_arbiter.clients.calibration.basis import Basis
from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.calibration.series import Series
from vram_arbiter.schemas.defaults import VERIFY_TIMEOUT_S
from vram_arbiter.schemas.errors import ProbeFailed, VramError
from vram_arbiter.schemas.runtime import procfs


class OwnBytes:
    """Bytes of the process tree below this process at each call. A process that was in the tree
    stays in it when its parent ends."""

    def __init__(self, gpu: Gpu, basis: Basis) -> None:
        self._root = os.getpid()
        self._gpu = gpu
        self._basis = basis
        self._seen: set[tuple[int, int]] = set()

    def __call__(self) -> int:
        reading = self._gpu.read()
        if not self._basis.listed:
            return max(0, reading.used_bytes - self._basis.baseline_bytes)
        if reading.processes is None:
            raise ProbeFailed(
                "the driver stopped listing processes in the middle of the measurement",
                hint="see nvidia-smi and dmesg",
            )
        return sum(count for pid, count in reading.processes.items() if self._is_ours(pid))

    def _is_ours(self, pid: int) -> bool:
        stat = procfs.read_stat(pid)
        if stat is None:
            return False
        key, parent = (pid, stat.start_ticks), stat.parent_pid
        while key not in self._seen and parent > 1:
            if parent == self._root:
                self._seen.add(key)
                break
            above = procfs.read_stat(parent)
            parent = 0 if above is None else above.parent_pid
        return key in self._seen


class Sampler:
    """Series of readings, made by a thread. `step` makes one."""

    def __init__(
        self,
        read: Callable[[], int],
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.series = Series()
        self.clock = clock
        self._read = read
        self._period_s = period_s
        self._error: VramError | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="readings", daemon=True)

    def __enter__(self) -> "Sampler":
        self.step()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(VERIFY_TIMEOUT_S)  # a driver may hang

    def step(self) -> None:
        """Make one reading. The time is that of its end: bytes are never dated before a mark that
        they follow."""
        count = self._read()
        self.series.add(self.clock(), count)

    def check(self) -> None:
        """Raise what ended the readings."""
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        due_s = self.clock()
        while True:
            due_s = max(due_s + self._period_s, self.clock())
            if self._over.wait(max(0.0, due_s - self.clock())):
                return
            try:
                self.step()
            except VramError as error:
                self._error = error
                return
