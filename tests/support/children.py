"""Consumers of a test as forked programs (`prepared`), which say JSON lines on their standard
output and take commands on their standard input."""

import contextlib
import json
import os
import select
import signal
import subprocess
import time
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from tests.support.prepared import Forked, start
from tests.support.waiting import PATIENCE_S

_READ_MAX = 65_536


class Child:
    """A program: what it says, what it is told, and its end."""

    def __init__(self, process: Forked, name: str, stdin: int, stdout: int) -> None:
        self.pid = process.pid
        self.name = name
        self.said: list[dict[str, Any]] = []
        self._process = process
        self._stdin = stdin
        self._stdout = stdout
        self._rest = b""
        self._heard = 0  # of `said`, how much `until` has handed out

    @property
    def alive(self) -> bool:
        return self._process.poll() is None

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
            left_s = max(0.0, deadline - time.monotonic())
            if not select.select([self._stdout], [], [], left_s)[0]:
                raise AssertionError(
                    f"{self.name} did not say {event!r} in {timeout_s:g} s: {self.said}"
                )
            if not self._read():
                raise AssertionError(f"{self.name} ended before it said {event!r}: {self.said}")

    def _read(self) -> bool:
        data = os.read(self._stdout, _READ_MAX)
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
        self._process.send_signal(number)

    def kill(self) -> None:
        self.signal(signal.SIGKILL)
        self.wait()

    def wait(self, timeout_s: float = PATIENCE_S) -> None:
        """Until it has ended. Raises AssertionError."""
        try:
            self._process.wait(timeout_s)
        except subprocess.TimeoutExpired:
            raise AssertionError(
                f"{self.name} did not end within {timeout_s:g} s: {self.said}"
            ) from None

    def close(self) -> None:
        """Kill it if it lives, and let go of its pipes."""
        self.kill()
        self.hang_up()
        os.close(self._stdout)


def spawn(
    program: str, *arguments: str, name: str, environ: Mapping[str, str], errors: Path
) -> Child:
    """Start one of `prepared.PROGRAMS`; its errors go to the end of a file."""
    stdin_there, stdin = os.pipe()
    stdout, stdout_there = os.pipe()
    with errors.open("ab") as log:
        process = start(program, arguments, environ, stdout_there, log.fileno(), stdin=stdin_there)
    os.close(stdin_there)
    os.close(stdout_there)
    return Child(process, name, stdin, stdout)
