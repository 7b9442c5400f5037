"""A program under observation: started in a session of its own, ended with all of it."""

import asyncio
import contextlib
import os
import signal
import sys
from collections.abc import Mapping, Sequence

from vram_arbiter.schemas.errors import CalibrationFailed

GRACE_S = 10.0
TAIL_BYTES = 4000
TAIL_LINES = 20


class ObservedProgram:
    """A program in a session of its own; its output goes to stderr, and its end is kept."""

    def __init__(self, process: asyncio.subprocess.Process, name: str) -> None:
        self._process = process
        self._name = name
        self._kept = b""
        self._reading = asyncio.create_task(self._pass_on(), name="output")

    @classmethod
    async def start(cls, command: Sequence[str], environ: Mapping[str, str]) -> "ObservedProgram":
        try:
            process = await asyncio.create_subprocess_exec(
                *command, env=environ, start_new_session=True,
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
        except OSError as error:
            raise CalibrationFailed(
                f"cannot start {command[0]}: {error.strerror}", hint="check the command"
            ) from error
        return cls(process, command[0])

    @property
    def pid(self) -> int:
        return self._process.pid

    async def ended(self) -> None:
        await self._process.wait()

    def check(self) -> None:
        """Raise CalibrationFailed for a program that ended by itself with a failure."""
        code = self._process.returncode
        if code:
            how = f"exit code {code}" if code > 0 else signal.Signals(-code).name
            raise CalibrationFailed(
                f"{self._name} ended with {how}; its last lines:\n{self.tail()}",
                hint="let it run to its end, or use --seconds",
                details={"exit_code": code, "log": self.tail()},
            )

    async def end(self) -> None:
        """End the whole session: SIGTERM, then SIGKILL."""
        for number, grace_s in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
            if self._process.returncode is not None:
                break
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), grace_s)
        await asyncio.wait({self._reading}, timeout=0.5)  # a child may keep the pipe open
        self._reading.cancel()

    def tail(self) -> str:
        lines = self._kept.decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:])

    async def _pass_on(self) -> None:
        assert self._process.stdout is not None, "it is a pipe"
        while piece := await self._process.stdout.read(1 << 16):
            sys.stderr.write(piece.decode(errors="replace"))
            sys.stderr.flush()
            self._kept = (self._kept + piece)[-TAIL_BYTES:]
