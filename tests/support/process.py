"""A real daemon for tests: `python -m vram_arbiter.arbiter` in a folder of its own, started until
READY, ended by its pid."""

import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.support.prepared import Forked, as_here, run, start
from tests.support.waiting import until

START_S = 60.0
STOP_S = 60.0
VRAMCTL_S = 240.0  # `demo --quick` takes 20 s, on a machine with other work minutes
PROGRAM = (sys.executable, "-m", "vram_arbiter.arbiter")
_ROOT = Path(__file__).parents[2]


class ArbiterProcess:
    """One runtime folder with at most one daemon in it at a time; it can be killed and started
    again on the same state.

    The folder is short (a socket path holds 107 bytes) and holds `arbiter.sock`, `state/`, the
    simulated GPU `fakegpu/` and `arbiter.log`. `environ` is what clients need to find it.
    `prepared`: fork the daemon from an interpreter that has imported it, unless it is started with
    a program or a path of libraries of its own: that is read by a new program alone.
    """

    def __init__(
        self,
        gpu: str = "fake:8GiB",
        arguments: Sequence[str] = (),
        config: str | None = None,
        *,
        prepared: bool = False,
    ) -> None:
        self.runtime = Path(tempfile.mkdtemp(prefix="va"))
        self.gpu = gpu
        self.arguments = list(arguments)
        if config is not None:
            (self.runtime / "arbiter.yaml").write_text(config)
            self.arguments += ["--config", str(self.runtime / "arbiter.yaml")]
        self.process: subprocess.Popen[bytes] | Forked | None = None
        self._prepared = prepared
        self.messages: list[str] = []
        self.program = list(PROGRAM)
        self._notify = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC)
        self._notify.bind(str(self.runtime / "notify.sock"))

    @property
    def endpoint(self) -> str:
        return f"ipc://{self.runtime}/arbiter.sock"

    @property
    def state(self) -> Path:
        return self.runtime / "state"

    @property
    def gpu_folder(self) -> Path:
        """Folder of the simulated GPU (`--gpu fake:SIZE`)."""
        return self.runtime / "fakegpu"

    @property
    def log(self) -> str:
        path = self.runtime / "arbiter.log"
        return path.read_text(errors="replace") if path.exists() else ""

    @property
    def pid(self) -> int:
        assert self.process is not None, "not started"
        return self.process.pid

    @property
    def environ(self) -> dict[str, str]:
        environ = {
            key: value
            for key, value in os.environ.items()
            if not key.startswith(("VRAM_ARBITER_", "WATCHDOG_", "OTEL_"))
        }
        environ["VRAM_ARBITER_RUNTIME"] = str(self.runtime)
        environ["PYTHONPATH"] = f"{_ROOT}/src:{_ROOT}"
        environ["PYTHONUNBUFFERED"] = "1"
        return environ

    def command(self, *more: str) -> list[str]:
        given = ["--gpu", self.gpu, "--state-dir", str(self.state)]
        return [*self.program, *given, *self.arguments, *more]

    def spawn(
        self, extra_environ: Mapping[str, str] | None = None
    ) -> "subprocess.Popen[bytes] | Forked":
        """Start the daemon without waiting for it."""
        assert self.process is None or self.process.poll() is not None, "already running"
        environ = {
            **self.environ,
            "NOTIFY_SOCKET": str(self.runtime / "notify.sock"),
            **(extra_environ or {}),
        }
        with (self.runtime / "arbiter.log").open("ab") as log:
            program, given = self.command()[: len(PROGRAM)], self.command()[len(PROGRAM) :]
            own = program != list(PROGRAM) or "LD_LIBRARY_PATH" in (extra_environ or {})
            if self._prepared and not own:
                self.process = start("vram-arbiter", given, environ, log.fileno(), log.fileno())
                return self.process
            self.process = subprocess.Popen(
                self.command(), env=environ, stdout=log, stderr=log, stdin=subprocess.DEVNULL
            )
        return self.process

    def start(self, extra_environ: Mapping[str, str] | None = None) -> "ArbiterProcess":
        """Start the daemon and wait until it says READY. Raises RuntimeError with its log if it
        ends or stays silent."""
        self.spawn(extra_environ)
        self.wait_for("READY=1", START_S)
        return self

    def wait_for(self, word: str, timeout_s: float) -> str:
        """Wait for a notification that holds `word`. Raises RuntimeError."""
        assert self.process is not None
        deadline = time.monotonic() + timeout_s
        if self.process.poll() is not None:
            died = os.open(
                "/dev/null", os.O_RDONLY
            )  # readable at once, as the pidfd of a dead process
        else:
            died = os.pidfd_open(self.process.pid)
        try:
            while True:
                readable, _, _ = select.select(
                    [self._notify.fileno(), died], [], [], max(0.0, deadline - time.monotonic())
                )
                if self._notify.fileno() in readable:
                    message = self._notify.recv(4096).decode()
                    self.messages.append(message)
                    if word in message:
                        return message
                elif died in readable:
                    raise RuntimeError(f"the arbiter ended with {self.process.wait()}:\n{self.log}")
                else:
                    raise RuntimeError(
                        f"no {word} from the arbiter within {timeout_s} s:\n{self.log}"
                    )
        finally:
            os.close(died)

    def heard(self, seconds: float) -> list[str]:
        """What the daemon tells its manager from now on, for so long; what it told before is put
        aside (`messages`)."""
        self._put_aside()
        found: list[str] = []
        deadline = time.monotonic() + seconds
        while select.select([self._notify.fileno()], [], [], max(0.0, deadline - time.monotonic()))[
            0
        ]:
            found.append(self._notify.recv(4096).decode())
        self.messages += found
        return found

    def _put_aside(self) -> None:
        """What the daemon has told by now. The kernel keeps no more than ten of its messages, and
        drops the rest."""
        while select.select([self._notify.fileno()], [], [], 0)[0]:
            self.messages.append(self._notify.recv(4096).decode())

    def stop(self) -> int:
        """SIGTERM, and its exit code."""
        return self._end(signal.SIGTERM)

    def kill(self) -> int:
        """SIGKILL."""
        return self._end(signal.SIGKILL)

    def _end(self, number: signal.Signals) -> int:
        assert self.process is not None
        self._put_aside()
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait(STOP_S)

    def close(self) -> None:
        """End the daemon if it runs and remove the folder."""
        if self.process is not None and self.process.poll() is None:
            self.process.kill()
            self.process.wait(STOP_S)
        self._notify.close()
        until(self._removed)

    def _removed(self) -> bool:
        """Remove the folder; False where a program that is ending wrote to it meanwhile."""
        shutil.rmtree(self.runtime, ignore_errors=True)
        return not self.runtime.exists()


type Finished = subprocess.CompletedProcess[str]
Make = Callable[..., ArbiterProcess]
"""Fixture `make_arbiter`."""


def vramctl(
    *arguments: str | bytes, environ: Mapping[str, str], user: int | None = None
) -> Finished:
    """Run `vramctl`, as another user if one is given, and return what it printed.

    It is forked from an interpreter that has imported it, unless its variables ask for another
    interpreter.
    """
    if not as_here(environ):
        assert user is None
        return subprocess.run(
            [sys.executable, "-m", "vram_arbiter.clients", *arguments],
            env=environ,
            capture_output=True,
            text=True,
            timeout=VRAMCTL_S,
            check=False,
        )
    words = [os.fsdecode(word) for word in arguments]
    return run("vramctl", words, environ, VRAMCTL_S, user=user)


def vramctl_at_once(
    commands: Sequence[Sequence[str]], *, environ: Mapping[str, str]
) -> Sequence[tuple[Sequence[str], Finished]]:
    """Run commands that wait side by side, and return each with what it printed."""
    with ThreadPoolExecutor(len(commands)) as pool:
        ended = pool.map(lambda words: vramctl(*words, environ=environ), commands)
        return list(zip(commands, ended, strict=True))
