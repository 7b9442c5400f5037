"""One run of a command, limited in time.

The command leads a session of its own, and what it leaves behind ends with it, so that hooks never
pile up: its processes are found, in whatever session, by a variable of their environment. Of its
output the beginning is logged.
"""

import asyncio
import contextlib
import itertools
import logging
import os
import signal
from collections.abc import Mapping, Sequence
from io import RawIOBase
from typing import Final

from vram_arbiter.schemas.errors import ActionFailed
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.printable import printable

log = logging.getLogger(__name__)

OUTPUT_MAX_BYTES: Final = 4096
"""Of one run; what is more is read and dropped."""
MARK: Final = "VRAM_ARBITER_HOOK_RUN"
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
    output, loop, late = bytearray(), asyncio.get_running_loop(), False
    with os.fdopen(reading, "rb", buffering=0) as pipe:
        child = await _start(command, body, {**environ, MARK: mark}, writing)
        loop.add_reader(pipe, _arrived, loop, pipe, output)
        try:
            if late := not await _ended(child, timeout_s):
                os.killpg(child.pid, signal.SIGTERM)
                await _ended(child, grace_s)
        finally:  # where it has ended, nothing here waits: a stop does not cut the delivery short
            if child.returncode is None:
                os.killpg(child.pid, signal.SIGKILL)
            _end_marked(f"{MARK}={mark}".encode())
            code = await child.wait()
            while _read(pipe, output) and len(output) < OUTPUT_MAX_BYTES:
                pass
            loop.remove_reader(pipe)
            if output:
                log.info("%s: %s", command[0], printable(output.decode(errors="replace").strip()))
    if late:
        raise ActionFailed(f"{command[0]} was not done within {timeout_s:g} s and was ended")
    if code:
        told = f"ended by signal {-code}" if code < 0 else f"failed with exit code {code}"
        raise ActionFailed(f"{command[0]} {told}", details={"exit_code": code})


async def _start(
    command: Sequence[str], body: bytes, environ: Mapping[str, str], output: int
) -> asyncio.subprocess.Process:
    given = os.memfd_create("event")  # a pipe would block on a command that does not read
    try:
        os.write(given, body)
        os.lseek(given, 0, os.SEEK_SET)
        return await asyncio.create_subprocess_exec(
            *command, stdin=given, stdout=output, stderr=output, env={**os.environ, **environ},
            start_new_session=True,
        )  # fmt: skip
    except (OSError, ValueError) as error:
        raise ActionFailed(f"{command[0]} cannot be started: {error}") from error
    finally:
        os.close(given)
        os.close(output)


def _arrived(loop: asyncio.AbstractEventLoop, pipe: RawIOBase, output: bytearray) -> None:
    if not _read(pipe, output):
        loop.remove_reader(pipe)  # at its end it would be readable for ever


def _read(pipe: RawIOBase, output: bytearray) -> bool:
    """Take what has come, and keep the beginning. Return False at the end, or if nothing has."""
    came = pipe.read(OUTPUT_MAX_BYTES) or b""
    output += came[: OUTPUT_MAX_BYTES - len(output)]
    return bool(came)


async def _ended(child: asyncio.subprocess.Process, timeout_s: float) -> bool:
    """Wait until a process has ended. Return whether it did in time."""
    with contextlib.suppress(TimeoutError):
        async with asyncio.timeout(timeout_s):
            await child.wait()
    return child.returncode is not None


def _end_marked(mark: bytes) -> None:
    """Kill the processes of one run."""
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
