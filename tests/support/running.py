"""A program of `prepared` that runs beside its test: what it is told, and what it prints."""

import contextlib
import os
import select
import time
from collections.abc import Iterator, Mapping, Sequence
from typing import IO

from tests.support.prepared import Forked, start
from tests.support.waiting import PATIENCE_S

ATTACK_S = 120.0
"""Longer than what is tested beside it."""


class Running:
    """The process, and what it has printed and the test has not read."""

    def __init__(self, process: Forked, stdin: IO[bytes], output: int, errors: int) -> None:
        self.process = process
        self._stdin = stdin
        self._pipes = {output: b"", errors: b""}
        self._output, self._errors = output, errors

    def tell(self, text: str = "") -> None:
        """Give it its whole input."""
        self._stdin.write(text.encode())
        self._stdin.close()

    def line(self) -> str:
        """Return its next line."""
        return self._until(self._output, b"\n")

    def said(self, words: str) -> str:
        """Return its errors up to these words."""
        return self._until(self._errors, words.encode())

    def ended(self, number: int = 0) -> int:
        """Send it a signal, if one is given, and return its exit code."""
        if number:
            self.process.send_signal(number)
        return self.process.wait(PATIENCE_S)

    def _until(self, pipe: int, end: bytes) -> str:
        deadline = time.monotonic() + PATIENCE_S
        while end not in self._pipes[pipe]:
            left = max(0.0, deadline - time.monotonic())
            data = os.read(pipe, 4096) if select.select([pipe], [], [], left)[0] else b""
            if not data:
                raise TimeoutError(f"no {end!r} after {self._pipes}")
            self._pipes[pipe] += data
        text, self._pipes[pipe] = self._pipes[pipe].split(end, 1)
        return text.decode()


@contextlib.contextmanager
def running(
    program: str, arguments: Sequence[str], environ: Mapping[str, str]
) -> Iterator[Running]:
    """Start a program; it is killed at the end of the block."""
    (given, stdin), (output, out), (errors, err) = (os.pipe() for _ in range(3))
    process = start(program, arguments, environ, out, err, stdin=given)
    for end in (given, out, err):
        os.close(end)
    with open(stdin, "wb") as told:
        try:
            yield Running(process, told, output, errors)
        finally:
            process.kill()
            process.wait(PATIENCE_S)
            os.close(output)
            os.close(errors)


@contextlib.contextmanager
def attacked(endpoint: str, attack: str, seconds: float = ATTACK_S) -> Iterator[Running]:
    """Run one of `attacks.ATTACKS` on a server, for so long or until the end of the block; it has
    begun."""
    words = [attack, endpoint.removeprefix("ipc://"), str(seconds)]
    with running("attacker", words, os.environ) as attacker:
        assert attacker.line() == "attacking"
        yield attacker
