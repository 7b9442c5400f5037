"""A daemon and `vramctl` for our own tests, forked from interpreters that have imported them."""

import os
import subprocess
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import IO, cast

from tests.support.paths import ROOT
from tests.support.prepared import as_here, run, start
from vram_arbiter.testing import daemon

LIBRARIES = "LD_LIBRARY_PATH"
VRAMCTL_S = 240.0  # `demo --quick` takes 20 s, on a machine with other work minutes


class ArbiterProcess(daemon.ArbiterProcess):
    """A daemon of this tree.

    `prepared`: fork it from an interpreter that has imported it, unless it is started with a
    program or a path of libraries of its own: that is read by a new program alone.
    """

    def __init__(
        self,
        gpu: str = "fake:8GiB",
        arguments: Sequence[str] = (),
        config: str | None = None,
        *,
        prepared: bool = False,
    ) -> None:
        super().__init__(gpu, arguments, config)
        self._prepared = prepared

    @property
    def environ(self) -> dict[str, str]:
        return super().environ | {"PYTHONPATH": f"{ROOT}/src:{ROOT}"}

    def _launch(self, environ: Mapping[str, str], log: IO[bytes]) -> subprocess.Popen[bytes]:
        program = self.command()[: len(daemon.PROGRAM)]
        own = program != list(daemon.PROGRAM) or environ.get(LIBRARIES) != os.environ.get(LIBRARIES)
        if not self._prepared or own:
            return super()._launch(environ, log)
        given = self.command()[len(program) :]
        forked = start("vram-arbiter", given, environ, log.fileno(), log.fileno())
        return cast("subprocess.Popen[bytes]", forked)  # it has the methods that are used

    def heard(self, seconds: float) -> list[str]:
        """What the daemon tells its manager from now on, for so long; what it told before is put
        aside (`messages`)."""
        while self._hear():
            pass
        before, deadline = len(self.messages), time.monotonic() + seconds
        while self._hear(max(0.0, deadline - time.monotonic())):
            pass
        return self.messages[before:]


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
