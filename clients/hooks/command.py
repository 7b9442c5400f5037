"""One run of a command, limited in time.

The command leads a process group of its own. The group ends with it: processes that it left behind
are killed, so that hooks never pile up. The leader is reaped last, so until then its pid names no
other group.
"""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import Mapping, Sequence
from typing import Final

from vram_arbiter.schemas.errors import ActionFailed

GRACE_S: Final = 5.0
"""From SIGTERM to SIGKILL."""


async def run_command(
    command: Sequence[str],
    body: bytes,
    environ: Mapping[str, str],
    timeout_s: float,
    grace_s: float = GRACE_S,
) -> None:
    """Run a command with `body` on its stdin. Its output goes to stderr.

    Raises ActionFailed if it cannot be started, fails, or is not done in time. If the caller is
    canceled, the command is killed.
    """
    child = _start(command, body, environ)
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
        os.close(pidfd)
    if late:
        raise ActionFailed(f"{command[0]} was not done within {timeout_s:g} s and was ended")
    if code:
        told = f"ended by signal {-code}" if code < 0 else f"failed with exit code {code}"
        raise ActionFailed(f"{command[0]} {told}", details={"exit_code": code})


def _start(
    command: Sequence[str], body: bytes, environ: Mapping[str, str]
) -> subprocess.Popen[bytes]:
    given = os.memfd_create("event")  # a pipe would block on a command that does not read
    try:
        os.write(given, body)
        os.lseek(given, 0, os.SEEK_SET)
        return subprocess.Popen(
            list(command),
            stdin=given,
            stdout=sys.stderr.fileno(),
            env={**os.environ, **environ},
            start_new_session=True,
        )
    except (OSError, ValueError) as error:
        raise ActionFailed(f"{command[0]} cannot be started: {error}") from error
    finally:
        os.close(given)


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
