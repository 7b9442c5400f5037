"""Programs of this package as children of a command, and an arbiter of their own: started by
`python -m`, watched, and ended again. Only processes started here are ever signalled."""

import asyncio
import os
import re
import shutil
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Sequence
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from pathlib import Path

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.foreign.program import dying_with_parent
from vram_arbiter.schemas.errors import ArbiterUnreachable, SidecarUnavailable
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE, RUNTIME_VARIABLE

START_S = 60.0
STOP_GRACE_S = 15.0
LOG_TAIL_LINES = 15


@dataclass(slots=True)
class Child:
    """One child process, of these words, and where its output goes."""

    name: str
    words: Sequence[str]
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
    """All children of one command, in the order of their start; `stop_all` ends them in reverse."""

    log_dir: Path
    environ: dict[str, str]
    running: dict[str, Child] = field(default_factory=dict)

    async def start(
        self, name: str, package: str, *arguments: str, asked: bool = False, **environ: str
    ) -> Child:
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
                env=dict(os.environ) | traces.environ() | self.environ | environ,
                preexec_fn=dying_with_parent(),
            )  # fmt: skip
        words = (package, *arguments)
        program = self.running[name] = Child(name, words, process, log)
        return program

    async def restart(self, name: str, number: signal.Signals = signal.SIGTERM) -> None:
        """Stop a program by the signal, and start it again."""
        await self.stop(name, number)
        await self.start(name, *self.running[name].words)

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


@asynccontextmanager
async def private_arbiter(
    name: str, gpu: str = "fake:8GiB", *flags: str
) -> AsyncIterator[tuple[Programs, AsyncClient]]:
    """Start an arbiter in a folder of its own, and connect to it as `name`; programs that are
    started beside it find it. All are ended and the folder is removed at the end of the block.

    Raises ArbiterUnreachable, SidecarUnavailable.
    """
    runtime = Path(tempfile.mkdtemp(prefix="vram-"))  # short, for the paths of its sockets
    endpoint = f"ipc://{runtime}/arbiter.sock"
    environ = {
        RUNTIME_VARIABLE: str(runtime),
        ENDPOINT_VARIABLE: endpoint,  # not the machine's own arbiter
        "TMPDIR": str(runtime),
    }
    if gpu.startswith("fake:"):
        environ[FOLDER_VARIABLE] = str(runtime / "fakegpu")
    programs = Programs(runtime, environ)
    words = ("--gpu", gpu, "--state-dir", str(runtime / "state"))
    try:
        await programs.start("arbiter", "arbiter", *words, *flags)
        async with AsyncClient(name, endpoint=endpoint, connect_timeout_s=START_S) as client:
            yield programs, client
    except ArbiterUnreachable:
        programs.check()  # says why it ended
        raise
    finally:
        await programs.stop_all()
        shutil.rmtree(runtime, ignore_errors=True)
