"""Programs of a demo or a self-test: started by `python -m`, watched, and ended again. Only
processes started here are ever signalled."""

import asyncio
import os
import re
import signal
import sys
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.foreign.program import dying_with_parent
from vram_arbiter.schemas.errors import SidecarUnavailable

STOP_GRACE_S = 15.0
LOG_TAIL_LINES = 15


@dataclass(slots=True)
class DemoProgram:
    """One child process and where its output goes."""

    name: str
    process: asyncio.subprocess.Process
    log: Path
    stopped: bool = False  # by this process

    def tail(self) -> str:
        """The last lines that it printed, for error messages."""
        lines = self.log.read_text(errors="replace").splitlines()
        return "\n".join(lines[-LOG_TAIL_LINES:])

    def said(self, pattern: str) -> str | None:
        """Return the first group of `pattern` in what it has printed so far."""
        found = re.search(pattern, self.log.read_text(errors="replace"), re.MULTILINE)
        return None if found is None else found[1]


@dataclass(slots=True)
class Programs:
    """All children of one demo, in the order of their start; `stop` ends them in reverse."""

    log_dir: Path
    environ: Mapping[str, str]
    running: dict[str, DemoProgram] = field(default_factory=dict)

    async def start(
        self, name: str, package: str, *arguments: str, asked: bool = False, **environ: str
    ) -> DemoProgram:
        """Start `python -m vram_arbiter.PACKAGE ARGUMENTS`, which dies with this process; its
        output goes to `<log_dir>/<name>.log`. `asked`: it reads from this process, and answers on
        its standard output."""
        log = self.log_dir / f"{name}.log"
        with log.open("wb") as sink:
            piped = asyncio.subprocess.PIPE
            process = await asyncio.create_subprocess_exec(
                sys.executable, "-m", f"vram_arbiter.{package}", *arguments,
                stdin=piped if asked else asyncio.subprocess.DEVNULL,
                stdout=piped if asked else sink, stderr=sink,
                env=dict(os.environ) | traces.environ() | dict(self.environ) | environ,
                preexec_fn=dying_with_parent(),
            )  # fmt: skip
        program = self.running[name] = DemoProgram(name, process, log)
        return program

    def pids(self) -> dict[int, str]:
        """Pid → name of everything started, also of what has ended since."""
        return {program.process.pid: program.name for program in self.running.values()}

    def check(self) -> None:
        """Raise SidecarUnavailable for a program that ended by itself."""
        for program in self.running.values():
            if program.process.returncode is not None and not program.stopped:
                raise SidecarUnavailable(
                    f"{program.name} ended with exit code "
                    f"{program.process.returncode}:\n{program.tail()}",
                    hint=f"its whole output is in {program.log}",
                )

    async def stop(self, name: str, number: signal.Signals = signal.SIGTERM) -> None:
        """Send the signal, and SIGKILL after a grace period."""
        program = self.running[name]
        if program.process.returncode is not None:
            return
        program.stopped = True
        program.process.send_signal(number)
        try:
            await asyncio.wait_for(program.process.wait(), STOP_GRACE_S)
        except TimeoutError:
            program.process.kill()
            await program.process.wait()

    async def stop_all(self) -> None:
        """End everything that still runs, last started first: clients leave before the arbiter
        does."""
        for name in reversed(list(self.running)):
            await self.stop(name)
