"""`vram-gateway` whose children `vramctl run` are forked from a process that has imported them and
the servers that they start (`run_program`): each would import for 0.7 s of a core.
"""

import asyncio
import os
from collections.abc import Mapping, Sequence
from types import SimpleNamespace

from tests.support.prepared import Forked, start
from vram_arbiter.sidecars.gateway import program
from vram_arbiter.sidecars.gateway.__main__ import main

__all__ = ["main"]


class _Process:
    """A forked program, with the part of `asyncio.subprocess.Process` that the gateway uses."""

    def __init__(self, forked: Forked, stdout: asyncio.StreamReader) -> None:
        self._forked, self.pid, self.stdout = forked, forked.pid, stdout

    async def wait(self) -> int:
        return await asyncio.to_thread(self._forked.wait)


async def _start(
    *command: str,
    env: Mapping[str, str],
    pass_fds: Sequence[int],
    start_new_session: bool,
    **_: object,
) -> _Process:
    arguments = command[len(program.VRAMCTL) :]
    printed, prints = os.pipe()
    with open(prints, "wb"):  # closed here once the child has it
        forked = await asyncio.to_thread(
            start, "vramctl-run", arguments, env, prints, prints, passed=pass_fds,
            session=start_new_session,
        )  # fmt: skip
    reader = asyncio.StreamReader()
    output = open(printed, "rb", buffering=0)  # noqa: SIM115  the transport closes it
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), output
    )
    return _Process(forked, reader)


vars(program)["asyncio"] = SimpleNamespace(**(vars(asyncio) | {"create_subprocess_exec": _start}))
