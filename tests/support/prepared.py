"""Programs forked from an interpreter that has imported them already.

Importing the daemon, `vramctl` or a sidecar for each test is most of what `make test` computes: an
import takes 0.3 to 9 s of a core, a fork some milliseconds. `start` returns what
`subprocess.Popen` would. A program whose imports matter is started afresh (`as_here`).

A server imports once for the whole run: it listens on an abstract socket that all processes of the
run know, the workers of pytest and programs that start programs, and ends with its last connection.
"""

import contextlib
import errno
import hashlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import IO

from tests.support import fork_server
from tests.support.paths import ROOT

MESSAGE_MAX = 1 << 17
DESCRIPTORS_MAX = 8
PRINTED_MAX = 1 << 27
HELLO = b"ready"
PATIENCE_S = 240.0  # imports on a machine with other work take minutes
INTERPRETER = ("PYTHON", "LANG", "LC_")
"""Variables that an interpreter reads when it starts."""


@dataclass(frozen=True, slots=True)
class Program:
    """A program: its `main` takes the arguments from `sys.argv` and may return the exit code.

    `imports`: what it would import later. `forks`: it starts a server of imports. `server`: the
    program whose server runs this one too, where both import the same.
    """

    module: str
    imports: Sequence[str] = ()
    forks: bool = False
    server: str = ""


CLIENT = ("anyio._backends._asyncio", "vram_arbiter.clients.client")
SIDECAR = (
    "anyio._backends._asyncio",
    "multiprocessing.popen_forkserver",
    "vram_arbiter.sidecars.device.fake",
    "vram_arbiter.sidecars.host",
    "vram_arbiter.sidecars.model_main",
)
PROGRAMS: Mapping[str, Program] = {
    "vram-arbiter": Program(
        "vram_arbiter.arbiter.__main__",
        (
            "email.parser",  # for its version
            "vram_arbiter.arbiter.daemon",
            "vram_arbiter.arbiter.host.process",
            "vram_arbiter.arbiter.log",
            "vram_arbiter.schemas.yamltext",
        ),
    ),
    "vramctl": Program(
        "vram_arbiter.clients.cli.main",
        (
            "anyio._backends._asyncio",
            "vram_arbiter.clients.client",
            "vram_arbiter.clients.cli.doctor",
            "vram_arbiter.clients.cli.history",
            "vram_arbiter.clients.cli.operators",
            "vram_arbiter.clients.cli.run",
            "vram_arbiter.clients.cli.status",
            "vram_arbiter.clients.cli.why",
        ),
    ),
    "vramctl-run": Program("tests.support.run_program", (*CLIENT, "vram_arbiter.clients.cli.run")),
    "vram-observer": Program(
        "vram_arbiter.clients.observer.__main__",
        ("anyio._backends._asyncio", "vram_arbiter.clients.observer.program"),
    ),
    "vram-gateway": Program(
        "tests.support.gateway_program",
        (
            "anyio._backends._asyncio",
            "vram_arbiter.clients.client",
            "vram_arbiter.sidecars.gateway.gateway",
        ),
    ),
    "echo": Program("tests.sidecars.echo_sidecar", SIDECAR, forks=True),
    "episode": Program("tests.e2e.episode_sidecar", (*SIDECAR, "numpy"), forks=True),
    "vram-sidecar": Program(
        "vram_arbiter.sidecars.__main__",
        (
            *SIDECAR,
            "transformers",
            "vram_arbiter.sidecars.preload_lerobot",
            "vram_arbiter.sidecars.models.compact_act",
        ),
        forks=True,
    ),
    "vram-runner": Program(
        "tests.support.runner_program",
        (
            "anyio._backends._asyncio",
            "cv2",
            "mujoco.egl",
            "numpy",
            "vram_arbiter.runner.robots.so101_mujoco",
            "vram_arbiter.runner.sensors.opencv_thread",
            *(
                f"vram_arbiter.runner.cli.{name}"
                for name in ("benchmark", "deploy", "deployment", "sim")
            ),
            "vram_arbiter.runner.benchmark.player",
            "vram_arbiter.runner.benchmark.worker",
            "vram_arbiter.runner.sim.policies",
            "vram_arbiter.runner.sim.env",
        ),
    ),
    "vram-reasoner": Program("vram_arbiter.reasoner.__main__", server="vram-runner"),
    "deploy-nod": Program("tests.runner.deploy_nod", server="vram-runner"),
    "neighbour": Program("tests.e2e.neighbour", CLIENT),
    "stepper": Program("tests.e2e.stepper", server="neighbour"),
    "script": Program("tests.support.script", server="vramctl"),
    "attacker": Program("tests.support.attacks", server="neighbour"),
    "storm-worker": Program("tests.chaos.worker", server="neighbour"),
    "op-server": Program("tests.support.server_process", server="echo"),
    "dataset-writer": Program("tests.support.dataset_writer", server="vram-sidecar"),
    "dataset-reader": Program("tests.support.dataset_reader", server="vram-sidecar"),
    "lerobot-train": Program("lerobot.scripts.lerobot_train", server="vram-sidecar"),
}


def as_here(environ: Mapping[str, str]) -> bool:
    """Return whether an interpreter with these variables would start as this one did."""
    return _of_interpreter(environ) == _of_interpreter(os.environ)


def _of_interpreter(environ: Mapping[str, str]) -> dict[str, str]:
    found = {key: value for key, value in environ.items() if key.startswith(INTERPRETER)}
    found.pop("PYTHONUNBUFFERED", None)
    found["PYTHONPATH"] = ":".join(found.get("PYTHONPATH", "").split(":")[:2])
    return found


class Forked:
    """A forked program, with the methods of `subprocess.Popen` that tests use."""

    def __init__(
        self, pid: int, pidfd: int, status: socket.socket, printed: Sequence[IO[bytes]]
    ) -> None:
        self.pid = pid
        self._printed = printed
        self.returncode: int | None = None
        self._pidfd = pidfd
        self._status = status
        self._ending = threading.Lock()

    def poll(self) -> int | None:
        """Return the exit code, -n after signal n; None while it runs."""
        return self._wait(0.0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._wait(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def communicate(self, timeout: float | None = None) -> tuple[str, str]:
        """Wait for its end. Return its outputs, where `start` was given no files for them."""
        self.wait(timeout)
        output, errors = (os.pread(one.fileno(), PRINTED_MAX, 0).decode() for one in self._printed)
        return output, errors

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _wait(self, timeout: float | None) -> int | None:
        try:
            if not select.select([self._status], [], [], timeout)[0]:
                return self.returncode
        except (ValueError, OSError):
            if self.returncode is None:  # else closed, by another thread that waited
                raise
        with self._ending:
            if self.returncode is None:
                self.returncode = int(self._status.recv(16))
                self._status.close()
                os.close(self._pidfd)
        return self.returncode


def start(
    program: str,
    arguments: Sequence[str],
    environ: Mapping[str, str],
    output: int | None = None,
    errors: int | None = None,
    *,
    cwd: Path | None = None,
    user: int | None = None,
    passed: Sequence[int] = (),
    session: bool = False,
    stdin: int | None = None,
) -> Forked:
    """Start one of PROGRAMS with its outputs in two open files, or for `communicate`; as another
    user if one is given, in a session of its own if `session`. It gets the descriptors `passed`
    under the same numbers."""
    given = {number: number for number in passed} | ({} if stdin is None else {0: stdin})
    printed = [
        tempfile.TemporaryFile()  # noqa: SIM115  they live as long as the program
        for one in (output, errors)
        if one is None
    ]
    files = iter(printed)
    order = {
        "program": program, "arguments": list(arguments), "environ": dict(environ),
        "cwd": str(cwd or os.getcwd()), "user": user, "session": session,
        "numbers": [1, 2, *given],
    }  # fmt: skip
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with there, _ORDERING:
        orders = _server(PROGRAMS[program].server or program)
        out, err = (next(files).fileno() if one is None else one for one in (output, errors))
        descriptors = [there.fileno(), out, err, *given.values()]
        socket.send_fds(orders, [json.dumps(order).encode()], descriptors)
        pid, (pidfd, *_), _, _ = socket.recv_fds(orders, 16, 1)
    return Forked(int(pid), pidfd, here, printed)


def run(
    program: str,
    arguments: Sequence[str],
    environ: Mapping[str, str],
    timeout_s: float,
    *,
    cwd: Path | None = None,
    user: int | None = None,
) -> subprocess.CompletedProcess[str]:
    """Run one of PROGRAMS to its end and return what it printed."""
    process = start(program, arguments, environ, cwd=cwd, user=user)
    try:
        printed = process.communicate(timeout_s)
    finally:
        process.kill()
    return subprocess.CompletedProcess([*arguments], process.wait(), *printed)


def warm(program: str) -> None:
    """Keep the server of a program that others start as long as this process runs."""
    with _ORDERING:
        _server(PROGRAMS[program].server or program)


_ORDERING = threading.Lock()


@cache
def _server(name: str) -> socket.socket:
    """Connect to the server of a program; start it where no process of the run has done so."""
    folder = os.environ.get("TMPDIR", "")  # of this run alone (`leftovers`)
    told = hashlib.sha256(f"{ROOT} {folder} {name}".encode()).hexdigest()
    address = f"\0vram-prepared-{told[:32]}"
    deadline = time.monotonic() + PATIENCE_S
    while time.monotonic() < deadline:
        orders = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        orders.settimeout(PATIENCE_S)
        # refused: there is none yet, or no longer; reset: it was about to end
        with contextlib.suppress(ConnectionRefusedError, ConnectionResetError):
            orders.connect(address)
            if orders.recv(len(HELLO)) == HELLO:
                return orders
        orders.close()
        _begin(name, address)
    raise TimeoutError(f"the server of {name} did not come up")


def _begin(name: str, address: str) -> None:
    """Start a server; nothing if another process is just doing so."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
        try:
            listener.bind(address)
        except OSError as error:
            if error.errno != errno.EADDRINUSE:
                raise
            threading.Event().wait(0.01)
            return
        listener.listen(64)
        environ = {**os.environ, "PYTHONPATH": f"{ROOT}/src:{ROOT}"}
        if PROGRAMS[name].forks:
            environ |= fork_server.importing()
        command = [sys.executable, "-u", "-m", "tests.support.prepared_server", name]
        server = subprocess.Popen(
            [*command, str(listener.fileno())],
            pass_fds=(listener.fileno(),),
            stdin=subprocess.DEVNULL,
            env=environ,
            cwd=ROOT,
        )
        _STARTED.append(server)


_STARTED: list[subprocess.Popen[bytes]] = []
"""Servers that this process started. Others of the run may need them longer: nobody waits."""
