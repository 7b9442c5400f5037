"""Many short-lived Python processes without paying for their imports each time.

`ForkServer(program)` starts one process that imports a program file and then forks a child per
`spawn`; the child runs the file's `main(arguments)` with pipes of its own, says JSON lines on its
standard output and takes commands on its standard input. Must not know what the program does. POSIX
only.
"""

import contextlib
import importlib.util
import json
import os
import select
import signal
import socket
import subprocess
import sys
import time
import traceback
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, Self

PATIENCE_S = 60.0
_MESSAGE_MAX = 65_536


class Child:
    """A forked process: what it says, what it is told, and its end. Deaths are seen through a
    pidfd."""

    def __init__(self, pid: int, name: str, stdin: int, stdout: int) -> None:
        self.pid = pid
        self.name = name
        self.pidfd = os.pidfd_open(pid)
        self.said: list[dict[str, Any]] = []
        self._stdin = stdin
        self._stdout = stdout
        self._rest = b""
        self._heard = 0  # of `said`, how much `until` has handed out

    @property
    def alive(self) -> bool:
        return self.pidfd not in select.select([self.pidfd], [], [], 0)[0]

    def until(self, event: str, timeout_s: float = PATIENCE_S) -> dict[str, Any]:
        """The next line with this event. Raises AssertionError if the child ends, or stays silent,
        before it says so."""
        deadline = time.monotonic() + timeout_s
        while True:
            while self._heard < len(self.said):
                line = self.said[self._heard]
                self._heard += 1
                if line["event"] == event:
                    return line
            ready, _, _ = select.select(
                [self._stdout], [], [], max(0.0, deadline - time.monotonic())
            )
            if not ready:
                raise AssertionError(
                    f"{self.name} did not say {event!r} in {timeout_s:g} s: {self.said}"
                )
            if not self._read():
                raise AssertionError(f"{self.name} ended before it said {event!r}: {self.said}")

    def _read(self) -> bool:
        data = os.read(self._stdout, _MESSAGE_MAX)
        *lines, self._rest = (self._rest + data).split(b"\n")
        self.said += [json.loads(line) for line in lines]
        return bool(data)

    def tell(self, command: str) -> None:
        """One line on its standard input; nothing if that is closed, or if it has ended."""
        if self._stdin < 0:
            return
        with contextlib.suppress(BrokenPipeError):
            os.write(self._stdin, f"{command}\n".encode())

    def hang_up(self) -> None:
        """Close its standard input."""
        if self._stdin >= 0:
            os.close(self._stdin)
            self._stdin = -1

    def signal(self, number: signal.Signals) -> None:
        """Through the pidfd: never to whoever got its pid afterwards."""
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(self.pidfd, number)

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        self.wait()

    def wait(self, timeout_s: float = PATIENCE_S) -> None:
        """Until it has ended. Raises AssertionError."""
        if self.pidfd not in select.select([self.pidfd], [], [], timeout_s)[0]:
            raise AssertionError(f"{self.name} did not end within {timeout_s:g} s: {self.said}")

    def close(self) -> None:
        """Kill it if it lives, and let go of its pipes."""
        self.kill()
        self.hang_up()
        os.close(self._stdout)
        os.close(self.pidfd)


class ForkServer:
    """The parent of all children. `close` ends it; the children live on and are closed by whoever
    spawned them."""

    def __init__(self, program: Path, environ: Mapping[str, str], errors: Path) -> None:
        here, there = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        with there, errors.open("ab") as log:
            self._process = subprocess.Popen(
                [
                    sys.executable,
                    "-m",
                    "tests.support.forkserver",
                    str(program),
                    str(there.fileno()),
                ],
                pass_fds=(there.fileno(),),
                env=dict(environ),
                stdin=subprocess.DEVNULL,
                stdout=subprocess.DEVNULL,
                stderr=log,
            )
        self._socket = here
        self._socket.settimeout(PATIENCE_S)

    @property
    def pid(self) -> int:
        return self._process.pid

    def spawn(self, *arguments: str, name: str | None = None, **environ: str) -> Child:
        """A child that runs `main(arguments)`, with these variables added to its environment."""
        stdin_there, stdin = os.pipe()
        stdout, stdout_there = os.pipe()
        order = json.dumps({"arguments": arguments, "environ": environ}).encode()
        socket.send_fds(self._socket, [order], [stdin_there, stdout_there])
        pid = int(self._socket.recv(64))
        os.close(stdin_there)
        os.close(stdout_there)
        return Child(pid, name or " ".join(arguments[:2]), stdin, stdout)

    def close(self) -> None:
        self._socket.close()
        self._process.wait(PATIENCE_S)

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


# -- the server's side
def serve(program: Path, orders: socket.socket) -> None:
    """Fork a child for every order until the other end is closed."""
    spec = importlib.util.spec_from_file_location(program.stem, program)
    if spec is None or spec.loader is None:
        raise SystemExit(f"{program} is no Python file")
    module = importlib.util.module_from_spec(spec)
    sys.modules[program.stem] = module
    spec.loader.exec_module(module)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)  # the kernel buries the children
    while True:
        text, descriptors, _, _ = socket.recv_fds(orders, _MESSAGE_MAX, 2)
        if not text:
            return
        order = json.loads(text)
        pid = os.fork()
        if pid == 0:
            orders.close()
            _become(module.main, order["arguments"], order["environ"], descriptors)
        for descriptor in descriptors:
            os.close(descriptor)
        orders.send(str(pid).encode())


def _become(
    main: Callable[[Sequence[str]], None],
    arguments: Sequence[str],
    environ: Mapping[str, str],
    descriptors: Sequence[int],
) -> None:
    code = 1
    try:
        signal.signal(signal.SIGCHLD, signal.SIG_DFL)
        for number, descriptor in enumerate(descriptors):
            os.dup2(descriptor, number)
            os.close(descriptor)
        os.environ.update(environ)
        main(arguments)
        sys.stdout.flush()
        code = 0
    except BaseException:  # noqa: BLE001 - outermost: it must never run on as a second server
        traceback.print_exc()
        sys.stderr.flush()
    finally:
        os._exit(code)


if __name__ == "__main__":
    serve(Path(sys.argv[1]), socket.socket(fileno=int(sys.argv[2])))
