"""Daemons forked from an interpreter that has imported the daemon already.

A daemon of its own for each test is most of what `make test` computes: an import takes 0.6 s of a
core, a fork some milliseconds. `start` returns what `subprocess.Popen` would. A daemon whose
imports matter (other environment, other program) is started afresh by `ArbiterProcess`.
"""

import atexit
import contextlib
import json
import os
import select
import signal
import socket
import subprocess
import sys
from collections.abc import Mapping, Sequence
from functools import cache

from tests.support.paths import ROOT

MESSAGE_MAX = 1 << 17
PATIENCE_S = 60.0


class Forked:
    """A forked daemon, with the methods of `subprocess.Popen` that tests use."""

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
            raise subprocess.TimeoutExpired(f"daemon {self.pid}", timeout or 0.0)
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


def start(arguments: Sequence[str], environ: Mapping[str, str], log: int) -> Forked:
    """Start `python -m vram_arbiter.arbiter ARGUMENTS`, with both outputs in the file `log`."""
    order = {"arguments": arguments, "environ": environ, "cwd": os.getcwd()}
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    orders = _server()
    with there:
        socket.send_fds(orders, [json.dumps(order).encode()], [log, there.fileno()])
    pid, (pidfd, *_), _, _ = socket.recv_fds(orders, 16, 1)
    return Forked(int(pid), pidfd, here)


@cache
def _server() -> socket.socket:
    """Start the server of this process, once."""
    here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    here.settimeout(PATIENCE_S)
    with there:
        process = subprocess.Popen(
            [sys.executable, "-u", "-m", "tests.support.prepared", str(there.fileno())],
            pass_fds=(there.fileno(),),
            stdin=subprocess.DEVNULL,
            env={**os.environ, "PYTHONPATH": f"{ROOT}/src:{ROOT}"},
            cwd=ROOT,
        )

    def end() -> None:
        here.close()  # the server ends with its orders
        process.wait(PATIENCE_S)

    atexit.register(end)
    return here


# -- the server's side
def serve(orders: socket.socket) -> list[str] | None:
    """Fork a daemon for each order. Returns its arguments in the child, None when orders end."""
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
            text, descriptors, _, _ = socket.recv_fds(orders, MESSAGE_MAX, 2)
            if not text:
                return None
            log, status = descriptors
            order = json.loads(text)
            pid = os.fork()
            if pid == 0:
                orders.close()
                os.close(status)
                for pidfd, (_, told) in running.items():
                    os.close(pidfd)
                    told.close()
                _become(order["environ"], order["cwd"], log)
                return list(order["arguments"])
            os.close(log)
            pidfd = os.pidfd_open(pid)
            running[pidfd] = (pid, socket.socket(fileno=status))
            socket.send_fds(orders, [str(pid).encode()], [pidfd])


def _become(environ: Mapping[str, str], cwd: str, log: int) -> None:
    os.environ.clear()
    os.environ.update(environ)
    os.chdir(cwd)
    os.dup2(log, 1)
    os.dup2(log, 2)
    os.close(log)


if __name__ == "__main__":
    import vram_arbiter.arbiter.daemon
    import vram_arbiter.arbiter.host.loop
    import vram_arbiter.arbiter.host.memory
    import vram_arbiter.arbiter.log  # noqa: F401
    from vram_arbiter.arbiter.__main__ import main

    given = serve(socket.socket(fileno=int(sys.argv[1])))
    if given is not None:
        sys.argv = ["vram-arbiter", *given]
        sys.exit(main(given))
