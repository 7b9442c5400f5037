"""A private daemon: `python -m vram_arbiter.arbiter` in a folder of its own, started until READY,
ended by its pid."""

import fcntl
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import IO, Final, Self

from vram_arbiter.testing.waiting import WITHIN_S, eventually

PROGRAM: Final = (sys.executable, "-m", "vram_arbiter.arbiter")
FOREIGN: Final = ("VRAM_ARBITER_", "WATCHDOG_", "OTEL_")
"""Variables with which a program would find another daemon or collector."""
KEEPS_BYTECODE: Final = {"PYTHONDONTWRITEBYTECODE": ""}
"""Images of containers set it: the daemon would compile all that it imports at each start."""


class ArbiterProcess:
    """One runtime folder with at most one daemon in it at a time; it can be killed and started
    again on the same state. A daemon dies with the process that started it.

    The folder `runtime` is short (a socket path holds 107 bytes) and holds `arbiter.sock`,
    `state/`, `arbiter.log` and the simulated GPU `fakegpu/` (`gpu_folder`; of several the first).
    `environ` is what clients need to find it.
    """

    def __init__(
        self, gpu: str = "fake:8GiB", arguments: Sequence[str] = (), config: str | None = None
    ) -> None:
        """`gpu` and `arguments` as of `vram-arbiter`; `config`: text of an arbiter.yaml."""
        self.runtime = Path(tempfile.mkdtemp(prefix="va"))
        self.endpoint = f"ipc://{self.runtime}/arbiter.sock"
        self.state = self.runtime / "state"
        self.gpu_folder = self.runtime / "fakegpu"
        self.gpu = gpu
        self.arguments = list(arguments)
        if config is not None:
            (self.runtime / "arbiter.yaml").write_text(config)
            self.arguments += ["--config", str(self.runtime / "arbiter.yaml")]
        self.process: subprocess.Popen[bytes] | None = None
        self.messages: list[str] = []
        self.program = list(PROGRAM)
        self._stdin, self._held = socket.socketpair()
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._notify.bind(str(self.runtime / "notify.sock"))

    @property
    def log(self) -> str:
        return (self.runtime / "arbiter.log").read_text(errors="replace")

    @property
    def pid(self) -> int:
        assert self.process is not None, "not started"
        return self.process.pid

    @property
    def environ(self) -> dict[str, str]:
        kept = {key: value for key, value in os.environ.items() if not key.startswith(FOREIGN)}
        return kept | {"VRAM_ARBITER_RUNTIME": str(self.runtime), "PYTHONUNBUFFERED": "1"}

    def command(self) -> list[str]:
        where = ["--gpu", self.gpu, "--state-dir", str(self.state)]
        return [*self.program, *where, *self.arguments]

    def spawn(self, extra_environ: Mapping[str, str] | None = None) -> subprocess.Popen[bytes]:
        """Start the daemon without waiting for it."""
        assert self.process is None or self.process.poll() is not None, "already running"
        own = KEEPS_BYTECODE | {"NOTIFY_SOCKET": str(self.runtime / "notify.sock")}
        with (self.runtime / "arbiter.log").open("ab") as log:
            self.process = self._launch(self.environ | own | dict(extra_environ or {}), log)
        return self.process

    def _launch(self, environ: Mapping[str, str], log: IO[bytes]) -> subprocess.Popen[bytes]:
        """Start the program. The kernel kills it when the other end of its standard input
        closes (fcntl(2), F_SETSIG), however this process ends; a parent-death signal would come
        with the end of the thread that started it."""
        process = subprocess.Popen(
            self.command(), env=environ, stdout=log, stderr=log, stdin=self._stdin.fileno()
        )
        fcntl.fcntl(self._stdin, fcntl.F_SETOWN, process.pid)
        fcntl.fcntl(self._stdin, fcntl.F_SETSIG, signal.SIGKILL)
        fcntl.fcntl(self._stdin, fcntl.F_SETFL, fcntl.FASYNC)
        return process

    def start(self, extra_environ: Mapping[str, str] | None = None) -> Self:
        """Start the daemon and wait until it says READY, as `wait_for`."""
        self.spawn(extra_environ)
        self.wait_for("READY=1")
        return self

    def wait_for(self, word: str, timeout_s: float = WITHIN_S) -> str:
        """Wait for a notification that holds `word`. Raises RuntimeError with the log if the daemon
        ends, and AssertionError if it stays silent."""

        def told() -> str:
            assert self.process is not None
            ended = self.process.poll()  # first: what it said before its end is still read
            while self._hear():
                if word in self.messages[-1]:
                    return self.messages[-1]
            if ended is not None:
                raise RuntimeError(f"the arbiter ended with {ended}:\n{self.log}")
            raise AssertionError(f"no {word} from the arbiter")

        return eventually(told, timeout_s)

    def _hear(self, within_s: float = 0.0) -> bool:
        """Read one notification; False if there is none."""
        if there := select.select([self._notify], [], [], within_s)[0]:
            self.messages.append(self._notify.recv(4096).decode())
        return bool(there)

    def kill(self) -> int:
        """SIGKILL."""
        return self.stop(signal.SIGKILL)

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send it a signal, and return its exit code."""
        assert self.process is not None
        while self._hear():  # the kernel keeps no more than ten, and drops the rest
            pass
        self.process.send_signal(number)
        return self.process.wait(WITHIN_S)

    def close(self) -> None:
        """End the daemon if it runs and remove the folder."""
        if self.process is not None and self.process.poll() is None:
            self.kill()
        for end in (self._notify, self._stdin, self._held):
            end.close()
        eventually(self._removed)

    def _removed(self) -> bool:
        """Remove the folder; False where a program that is ending wrote to it meanwhile."""
        shutil.rmtree(self.runtime, ignore_errors=True)
        return not self.runtime.exists()
