"""Programs forked from an interpreter that has imported them already.

Importing the daemon, `vramctl` or a sidecar for each test is most of what `make test` computes: an
import takes 0.3 to 0.6 s of a core, a fork some milliseconds. `start` returns what
`subprocess.Popen` would. A program whose imports matter is started afresh (`as_here`).
"""

import atexit
import contextlib
import gc
import json
import os
import select
import signal
import socket
import subprocess
import sys
import threading
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from importlib import import_module

from tests.support import fork_server
from tests.support.paths import ROOT

MESSAGE_MAX = 1 << 17
PATIENCE_S = 240.0  # imports on a machine with other work take minutes
INTERPRETER = ("PYTHON", "LANG", "LC_")
"""Variables that an interpreter reads when it starts."""


@dataclass(frozen=True, slots=True)
class Program:
    """A program of the product: its `main` takes the arguments from `sys.argv` and may return the
    exit code. `imports`: what it would import later. `forks`: it starts a server of imports."""

    module: str
    imports: Sequence[str] = ()
    forks: bool = False


SIDECAR = (
    "anyio._backends._asyncio",
    "vram_arbiter.sidecars.host",
    "vram_arbiter.sidecars.model_main",
)
PROGRAMS: Mapping[str, Program] = {
    "vram-arbiter": Program(
        "vram_arbiter.arbiter.__main__",
        (
            "vram_arbiter.arbiter.daemon",
            "vram_arbiter.arbiter.host.process",
            "vram_arbiter.arbiter.log",
        ),
    ),
    "vramctl": Program(
        "vram_arbiter.clients.cli.main",
        (
            "anyio._backends._asyncio",
            "vram_arbiter.clients.client",
            "vram_arbiter.clients.cli.doctor",
            "vram_arbiter.clients.cli.history",
            "vram_arbiter.clients.cli.hooks",
            "vram_arbiter.clients.cli.operators",
            "vram_arbiter.clients.cli.run",
            "vram_arbiter.clients.cli.status",
            "vram_arbiter.clients.cli.watch",
            "vram_arbiter.clients.cli.why",
        ),
    ),
    "echo": Program("tests.sidecars.echo_sidecar", SIDECAR, forks=True),
    "episode": Program("tests.e2e.episode_sidecar", (*SIDECAR, "numpy"), forks=True),
    "vram-sidecar": Program(
        "vram_arbiter.sidecars.__main__",
        (*SIDECAR, "transformers", "vram_arbiter.sidecars.preload_lerobot"),
        forks=True,
    ),
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

    def __init__(self, pid: int, pidfd: int, status: socket.socket) -> None:
        self.pid = pid
        self.returncode: int | None = None
        self._pidfd = pidfd
        self._status = status

    def poll(self) -> int | None:
        """Return the exit code, -n after signal n; None while it runs."""
        return self._wait(0.0)

    def wait(self, timeout: float | None = None) -> int:
        code = self._wait(timeout)
        if code is None:
            raise subprocess.TimeoutExpired(f"process {self.pid}", timeout or 0.0)
        return code

    def send_signal(self, number: int) -> None:
        if self.poll() is None:
            with contextlib.suppress(ProcessLookupError):
                signal.pidfd_send_signal(self._pidfd, number)

    def terminate(self) -> None:
        self.send_signal(signal.SIGTERM)

    def kill(self) -> None:
        self.send_signal(signal.SIGKILL)

    def _wait(self, timeout: float | None) -> int | None:
        if self.returncode is None and select.select([self._status], [], [], timeout)[0]:
            self.returncode = int(self._status.recv(16))
            self._status.close()
            os.close(self._pidfd)
        return self.returncode


def start(
    program: str,
    arguments: Sequence[str],
    environ: Mapping[str, str],
    output: int,
    errors: int,
    *,
    user: int | None = None,
) -> Forked:
    """Start one of PROGRAMS with its outputs in two open files, as another user if one is given."""
    order = {"arguments": arguments, "environ": dict(environ), "cwd": os.getcwd(), "user": user}
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    with _ORDERING:
        orders = _server(program)
    with there, _ORDERING:
        descriptors = [output, errors, there.fileno()]
        socket.send_fds(orders, [json.dumps(order).encode()], descriptors)
        pid, (pidfd, *_), _, _ = socket.recv_fds(orders, 16, 1)
    return Forked(int(pid), pidfd, here)


_ORDERING = threading.Lock()


@cache
def _server(program: str) -> socket.socket:
    """Start the server of a program, once in this process."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    here.settimeout(PATIENCE_S)
    environ = {**os.environ, "PYTHONPATH": f"{ROOT}/src:{ROOT}"}
    if PROGRAMS[program].forks:
        environ |= fork_server.importing()
    with there:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tests.support.prepared", program, str(there.fileno())],
            pass_fds=(there.fileno(),),
            stdin=subprocess.DEVNULL,
            env=environ,
            cwd=ROOT,
        )

    def end() -> None:
        here.close()  # the server ends with its orders
        process.wait(PATIENCE_S)

    atexit.register(end)
    return here


# -- the server's side
def serve(orders: socket.socket) -> list[str] | None:
    """Fork a program for each order. Returns its arguments in the child, None when orders end."""
    running: dict[int, tuple[int, socket.socket]] = {}  # pidfd → pid, where its status goes
    while True:
        for ready in select.select([orders, *running], [], [])[0]:
            if ready is not orders:
                pid, told = running.pop(ready)
                code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
                with told, contextlib.suppress(OSError):  # the test may have ended
                    told.send(str(code).encode())
                os.close(ready)
                continue
            text, descriptors, _, _ = socket.recv_fds(orders, MESSAGE_MAX, 3)
            if not text:
                return None
            output, errors, status = descriptors
            order = json.loads(text)
            pid = os.fork()
            if pid == 0:
                orders.close()
                os.close(status)
                for pidfd, (_, told) in running.items():
                    os.close(pidfd)
                    told.close()
                os.dup2(output, 1)
                os.dup2(errors, 2)
                os.close(output)
                os.close(errors)
                _become(order["environ"], order["cwd"], order["user"])
                return list(order["arguments"])
            os.close(output)
            os.close(errors)
            pidfd = os.pidfd_open(pid)
            running[pidfd] = (pid, socket.socket(fileno=status))
            socket.send_fds(orders, [str(pid).encode()], [pidfd])


def _become(environ: Mapping[str, str], cwd: str, user: int | None) -> None:
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(cwd)
    if user is not None:
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)


if __name__ == "__main__":
    name, descriptor = sys.argv[1:]
    for imported in PROGRAMS[name].imports:
        import_module(imported)
    main = import_module(PROGRAMS[name].module).main
    gc.freeze()  # collections in the children need not copy these pages
    given = serve(socket.socket(fileno=int(descriptor)))
    if given is not None:
        sys.argv = [name, *given]
        if PROGRAMS[name].forks:
            fork_server.lend()
        sys.exit(main())
