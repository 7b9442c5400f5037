"""Writer on a simulated GPU (`schemas.fakegpu`): this process's bytes, changed under its lock.

Thread-safe. Must not know leases or models. The daemon's reader is separate code: programs meet in
files, as they meet on sockets.
"""

import contextlib
import fcntl
import os
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import RESIDUE_BYTES
from vram_arbiter.schemas.errors import NoGpu
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.sidecars.device.memory import Block


class FakeMemory:
    """`DeviceMemory` on the simulated GPU in `folder`. Raises NoGpu if there is none.

    The weights themselves stay in host memory; the GPU is charged the footprint of the production
    model. `context_bytes` is the cost of the first touch (a CUDA context with its libraries).
    """

    torch_device = "cpu"

    def __init__(self, folder: Path, name: str, context_bytes: int = RESIDUE_BYTES) -> None:
        self._folder = folder
        self._name = name
        self._context_bytes = context_bytes
        self._key = ProcessKey(os.getpid(), _start_ticks(os.getpid()) or 0)
        self._thread_lock = (
            threading.Lock()
        )  # flock guards against other processes, not against threads of this one
        self._number = 0
        if not (folder / fakegpu.CARD_FILE).exists():
            raise NoGpu(
                f"no simulated GPU in {folder}", hint="start the arbiter with --gpu fake:8GiB"
            )

    def bind(self, gpu: str) -> str | None:
        return None  # the lease names the GPU of this folder

    def touch(self) -> None:
        """Create the context. Raises SimulatedOutOfMemory if it does not fit."""
        self._do(
            lambda card, now: fakegpu.touch(card, self._key, self._name, self._context_bytes, now)
        )

    def allocate(self, label: str, size_bytes: int) -> Block:
        """Allocate bytes. Raises SimulatedOutOfMemory."""

        def change(card: fakegpu.Card, now: float) -> fakegpu.Change:
            touched = fakegpu.touch(card, self._key, self._name, self._context_bytes, now)
            return touched.then(
                lambda c: fakegpu.allocate(c, self._key, self._name, label, size_bytes, now)
            )

        self._do(change)
        self._number += 1
        return Block(label, size_bytes, self._number)

    def free(self, block: Block) -> None:
        self._do(
            lambda card, now: fakegpu.free(card, self._key, block.label, block.size_bytes, now)
        )

    def empty_cache(self) -> None:
        self._do(lambda card, now: fakegpu.empty_cache(card, self._key, now))

    def used_bytes(self) -> int | None:
        process = self._do(lambda card, now: fakegpu.Change(card)).process(self._key)
        return process.own_bytes if process else 0

    def throttle_bytes_per_s(self) -> int | None:
        return fakegpu.parse_config(
            (self._folder / fakegpu.CARD_FILE).read_text()
        ).throttle_bytes_per_s

    def close(self) -> None:
        """Destroy the context and all allocations, as an orderly exit does."""
        if (self._folder / fakegpu.CARD_FILE).exists():
            self._do(lambda card, now: fakegpu.leave(card, self._key, now))

    def _do(self, transition: Callable[[fakegpu.Card, float], fakegpu.Change]) -> fakegpu.Card:
        """Make one change under the lock: read, let time pass, change, write.

        A refusal is recorded and raised.
        """
        with self._thread_lock, self._locked():
            now = time.monotonic()
            change = (
                fakegpu.read_card(self._texts(), self._log_tail())
                .then(lambda card: fakegpu.settle(card, now, _alive))
                .then(lambda card: transition(card, now))
            )
            for step in change.steps:
                self._perform(step)
        if change.error is not None:
            raise change.error
        return change.card

    @contextlib.contextmanager
    def _locked(self) -> Iterator[None]:
        lock = os.open(
            self._folder / fakegpu.LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660
        )
        try:
            fcntl.flock(lock, fcntl.LOCK_EX)
            yield
        finally:
            os.close(lock)

    def _texts(self) -> dict[str, str]:
        names = os.listdir(self._folder)
        return {
            n: (self._folder / n).read_text()
            for n in names
            if n == fakegpu.CARD_FILE or fakegpu.is_process_file(n)
        }

    def _log_tail(self) -> str:
        try:
            with (self._folder / fakegpu.LOG_FILE).open("rb") as log:
                log.seek(max(0, log.seek(0, os.SEEK_END) - fakegpu.LOG_TAIL_BYTES))
                return log.read().decode(errors="replace")
        except FileNotFoundError:
            return ""

    def _perform(self, step: fakegpu.Step) -> None:
        if step.text is not None:
            temporary = self._folder / f".{step.name}.tmp"
            temporary.write_text(step.text)
            temporary.rename(self._folder / step.name)
        elif step.name:
            (self._folder / step.name).unlink(missing_ok=True)
        if step.line:
            with (self._folder / fakegpu.LOG_FILE).open("ab", buffering=0) as log:
                log.write(step.line.encode())


def _start_ticks(pid: int) -> int | None:
    """Return the start time of a live process; None if it is dead."""
    try:
        alive, start_ticks = fakegpu.parse_stat(Path(f"/proc/{pid}/stat").read_bytes())
    except (FileNotFoundError, ProcessLookupError):
        return None
    return start_ticks if alive else None


def _alive(key: ProcessKey) -> bool:
    start_ticks = _start_ticks(key.pid)
    return start_ticks is not None and key.start_ticks in (0, start_ticks)
