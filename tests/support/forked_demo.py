"""`python -m tests.support.forked_demo demo …`: `vramctl demo` whose programs are forked from
processes that have imported them (`prepared`): three models and a simulator import for 40 s of a
core."""

import asyncio
from collections.abc import Mapping
from types import SimpleNamespace
from typing import IO

from tests.support.prepared import Forked, start
from vram_arbiter.clients.cli import programs
from vram_arbiter.clients.cli.main import main

PROGRAMS = {
    "vram_arbiter.arbiter": "vram-arbiter",
    "vram_arbiter.sidecars": "vram-sidecar",
    "vram_arbiter.runner": "vram-runner",
    "vram_arbiter.reasoner": "vram-reasoner",
}


class _Process:
    """A forked program, with the methods of `asyncio.subprocess.Process` that the demo uses."""

    def __init__(self, forked: Forked) -> None:
        self.pid, self.send_signal, self.kill = forked.pid, forked.send_signal, forked.kill
        self._forked = forked

    @property
    def returncode(self) -> int | None:
        return self._forked.poll()

    async def wait(self) -> int:
        return await asyncio.to_thread(self._forked.wait)


async def _start_fork(
    _python: str, _m: str, module: str, *arguments: str, stdout: IO[bytes], env: Mapping[str, str],
    **_: object,
) -> _Process:  # fmt: skip
    sink = stdout.fileno()
    return _Process(await asyncio.to_thread(start, PROGRAMS[module], arguments, env, sink, sink))


vars(programs)["asyncio"] = SimpleNamespace(
    create_subprocess_exec=_start_fork, subprocess=asyncio.subprocess, wait_for=asyncio.wait_for
)

if __name__ == "__main__":
    main()
