"""The folder of a simulated GPU (`schemas.fakegpu`): read and changed under its lock.

The lock is a plain `flock`, because waiters must wake at once (a polling lock file would add its
interval to every allocation) and because the kernel frees it when its holder dies.
"""

import contextlib
import fcntl
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path

from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs


@contextlib.contextmanager
def locked(folder: Path) -> Iterator[None]:
    """Hold the GPU's lock; wait while another process has it."""
    lock = os.open(folder / fakegpu.LOCK_FILE, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o660)
    try:
        fcntl.flock(lock, fcntl.LOCK_EX)
        yield
    finally:
        os.close(lock)


def settled(folder: Path) -> fakegpu.GpuState:
    """Return the GPU as it is now. The caller holds the lock.

    Deaths and due returns since the last reading are written down first.
    """
    return change(folder, fakegpu.Change)


def change(
    folder: Path, transition: Callable[[fakegpu.GpuState], fakegpu.Change]
) -> fakegpu.GpuState:
    """Let time pass, apply `transition`, and write what changed. The caller holds the lock.

    Raises the error of a transition that was refused, after it is written to the log.
    """
    names = [
        name
        for name in os.listdir(folder)
        if name == fakegpu.GPU_FILE or fakegpu.is_process_file(name)
    ]
    texts = {name: (folder / name).read_text() for name in names}
    now = time.monotonic()
    found = (
        fakegpu.read_gpu(texts, _tail(folder / fakegpu.LOG_FILE))
        .then(lambda gpu: fakegpu.settle(gpu, now, alive))
        .then(transition)
    )
    for step in found.steps:
        _perform(folder, step)
    if found.error is not None:
        raise found.error
    return found.gpu


def replace(path: Path, text: str) -> None:
    """Write a file so that readers see the old text or the new one."""
    temporary = path.with_name(f".{path.name}.tmp")
    temporary.write_text(text)
    temporary.rename(path)


def alive(key: ProcessKey) -> bool:
    """Whether the process lives; start ticks 0 stand for any process with that pid."""
    stat = procfs.read_stat(key.pid)
    return stat is not None and stat.alive and key.start_ticks in (0, stat.start_ticks)


def _perform(folder: Path, step: fakegpu.Edit) -> None:
    if step.text is not None:
        replace(folder / step.name, step.text)
    elif step.name:
        (folder / step.name).unlink(missing_ok=True)
    if step.line:
        flags = os.O_WRONLY | os.O_APPEND | os.O_CREAT | os.O_CLOEXEC
        log = os.open(folder / fakegpu.LOG_FILE, flags, 0o660)
        try:
            os.write(log, step.line.encode())
        finally:
            os.close(log)


def _tail(log: Path) -> str:
    try:
        with log.open("rb") as file:
            end = file.seek(0, os.SEEK_END)
            file.seek(max(0, end - fakegpu.LOG_TAIL_BYTES))
            return file.read().decode(errors="replace")
    except FileNotFoundError:
        return ""
