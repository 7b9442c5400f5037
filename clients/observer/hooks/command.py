"""One run of a command, limited in time.

The command leads a process group of its own. The group ends with it: processes that it left behind
are killed, so that hooks never pile up; those in a session of their own are found by a variable of
their environment. The leader is reaped last, so until then its pid names no other group. Of its
output the beginning is logged.
"""

import asyncio
import contextlib
import itertools
import logging
import os
import signal
import subprocess
from collections.abc import Mapping, Sequence
from typing import Final

from vram_arbiter.schemas.errors import ActionFailed
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.printable import printable

log = logging.getLogger(__name__)

OUTPUT_MAX_BYTES: Final = 4096
"""Of one run; what is more is read and dropped."""
MARK: Final = "VRAM_ARBITER_HOOK_RUN"
READS_MAX: Final = 32
"""After the end: a process of another user may go on writing."""
ROUNDS: Final = 3
"""A process may fork while its kin are looked for."""
_runs = itertools.count()
GRACE_S: Final = 5.0
"""From SIGTERM to SIGKILL."""


async def run_command(
    command: Sequence[str],
    body: bytes,
    environ: Mapping[str, str],
    timeout_s: float,
    grace_s: float = GRACE_S,
) -> None:
    """Run a command with `body` on its stdin, and log its output.

    Raises ActionFailed if it cannot be started, fails, or is not done in time. If the caller is
    canceled, the command is killed.
    """
    mark = f"{os.getpid()}-{next(_runs)}"
    reading, writing = os.pipe()
    os.set_blocking(reading, False)
    output = bytearray()
    try:
        child = _start(command, body, {**environ, MARK: mark}, writing)
    except BaseException:
        os.close(reading)
        raise
    finally:
        os.close(writing)
    loop = asyncio.get_running_loop()
    loop.add_reader(reading, _arrived, loop, reading, output)
    pidfd = os.pidfd_open(child.pid)
    late = False
    try:
        if not await _ended(pidfd, timeout_s):
            late = True
            _signal_group(child.pid, signal.SIGTERM)
            await _ended(pidfd, grace_s)
    finally:
        _signal_group(child.pid, signal.SIGKILL)
        code = child.wait()
        _end_marked(f"{MARK}={mark}".encode())
        loop.remove_reader(reading)
        for _ in range(READS_MAX):
            if not _read(reading, output):
                break
        os.close(reading)
        os.close(pidfd)
        if output:
            log.info("%s: %s", command[0], printable(output.decode(errors="replace").strip()))
    if late:
        raise ActionFailed(f"{command[0]} was not done within {timeout_s:g} s and was ended")
    if code:
        told = f"ended by signal {-code}" if code < 0 else f"failed with exit code {code}"
        raise ActionFailed(f"{command[0]} {told}", details={"exit_code": code})


def _start(
    command: Sequence[str], body: bytes, environ: Mapping[str, str], output: int
) -> subprocess.Popen[bytes]:
    given = os.memfd_create("event")  # a pipe would block on a command that does not read
    try:
        os.write(given, body)
        os.lseek(given, 0, os.SEEK_SET)
        return subprocess.Popen(
            list(command),
            stdin=given,
            stdout=output,
            stderr=output,
            env={**os.environ, **environ},
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise ActionFailed(f"{command[0]} cannot be started: {error}") from error
    finally:
        os.close(given)


def _arrived(loop: asyncio.AbstractEventLoop, pipe: int, output: bytearray) -> None:
    if not _read(pipe, output):
        loop.remove_reader(pipe)  # at its end it would be readable for ever


def _read(pipe: int, output: bytearray) -> bool:
    """Take what has come. Return False at the end, and where nothing has."""
    try:
        came = os.read(pipe, OUTPUT_MAX_BYTES)
    except BlockingIOError:
        return False
    output += came[: OUTPUT_MAX_BYTES - len(output)]
    return bool(came)


def _end_marked(mark: bytes) -> None:
    """Kill the processes of one run, in whatever session they are."""
    for _ in range(ROUNDS):
        pids = [int(entry.name) for entry in procfs.PROC.iterdir() if entry.name.isdecimal()]
        ended = [pid for pid in pids if _end_if_marked(pid, mark)]
        if not ended:
            break


def _end_if_marked(pid: int, mark: bytes) -> bool:
    """Return whether a process had the mark; one that has ended, or is another user's, has not."""
    with contextlib.suppress(OSError), contextlib.ExitStack() as stack:
        pidfd = os.pidfd_open(pid)
        stack.callback(os.close, pidfd)
        # read after the pidfd names the process
        if mark in (procfs.PROC / str(pid) / "environ").read_bytes().split(b"\0"):
            signal.pidfd_send_signal(pidfd, signal.SIGKILL)
            return True
    return False


async def _ended(pidfd: int, timeout_s: float) -> bool:
    """Wait until a process has ended. Return whether it did in time."""
    loop = asyncio.get_running_loop()
    ended = asyncio.Event()
    loop.add_reader(pidfd, ended.set)
    try:
        async with asyncio.timeout(timeout_s):
            await ended.wait()
    except TimeoutError:
        return False
    finally:
        loop.remove_reader(pidfd)
    return True


def _signal_group(leader: int, number: signal.Signals) -> None:
    with contextlib.suppress(ProcessLookupError):
        os.killpg(leader, number)
