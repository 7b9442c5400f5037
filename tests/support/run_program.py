"""`vramctl run` whose servers, stand-ins of the tests, are forked from it: each interpreter would
import aiohttp and the stand-in for 0.8 s of a core.
"""

import asyncio
import os
import signal
import sys
from collections.abc import Callable, Mapping
from types import SimpleNamespace
from typing import Any, NoReturn

from tests.support import openai_server
from vram_arbiter.clients.cli.main import main
from vram_arbiter.clients.foreign import program

__all__ = ["COMMAND", "main"]

COMMAND = (sys.executable, "-m", openai_server.__name__)
"""What is forked; any other command is executed."""


async def _start(
    *command: str, env: Mapping[str, str], preexec_fn: Callable[[], None], **options: Any
) -> asyncio.subprocess.Process:
    def become() -> NoReturn:
        """Be the server, in the child that would execute it."""
        preexec_fn()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGCHLD):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGPIPE, signal.SIG_IGN)  # as an interpreter does that starts
        os.closerange(3, os.sysconf("SC_OPEN_MAX"))
        os.environ.clear()
        os.environ.update(env)
        code = 1
        try:
            openai_server.main(*command[len(COMMAND) :])
            code = 0
        except BaseException:  # noqa: BLE001  it must never run on as a second `vramctl`
            sys.excepthook(*sys.exc_info())
        finally:
            sys.stdout.flush()
            os._exit(code)

    forks = command[: len(COMMAND)] == COMMAND
    return await asyncio.create_subprocess_exec(
        *command, env=env, preexec_fn=become if forks else preexec_fn, **options
    )


vars(program)["asyncio"] = SimpleNamespace(**(vars(asyncio) | {"create_subprocess_exec": _start}))
