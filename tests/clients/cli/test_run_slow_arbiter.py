"""`vramctl run` where the arbiter answers late or not as hoped: the program has begun, and is
neither cut off from its signals nor left alone."""

import asyncio
import contextlib
import os
import signal
import subprocess
import sys
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

import pytest

from tests.support.grants_at_once import GrantsAtOnce
from vram_arbiter.schemas.errors import LeaseLost

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

WAIT_S = 60.0
PROGRAM = (
    "import os, signal, sys; signal.signal(15, lambda *_: sys.exit(5)); print(os.getpid(), "
    "flush=True); signal.pause()"
)


@asynccontextmanager
async def vramctl_run(endpoint: str) -> AsyncIterator[asyncio.subprocess.Process]:
    """A program that ends with 5 on SIGTERM, once it is up."""
    process = await asyncio.create_subprocess_exec(
        sys.executable, "-m", "vram_arbiter.clients", "run", "--vram", "1GiB", "--name", "job",
        "--", sys.executable, "-c", PROGRAM,
        env={**os.environ, "VRAM_ARBITER_ENDPOINT": endpoint}, stdout=subprocess.PIPE,
    )  # fmt: skip
    assert process.stdout is not None
    program = os.pidfd_open(int(await process.stdout.readline()))
    try:
        yield process
    finally:
        with contextlib.suppress(ProcessLookupError):
            signal.pidfd_send_signal(program, signal.SIGKILL)
        os.close(program)
        if process.returncode is None:
            process.kill()
            await process.wait()


async def test_a_signal_reaches_the_program_although_the_arbiter_has_not_heard_that_it_runs() -> (
    None
):
    """Regression: until `ready` was answered nobody listened for signals. vramctl ended, its
    program stayed without a lease."""
    arbiter = GrantsAtOnce(ready=None)
    async with (
        asyncio.timeout(WAIT_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as process,
    ):
        process.send_signal(signal.SIGTERM)
        assert await process.wait() == 5
    assert arbiter.heard[-2:] == ["release", "bye"]


async def test_a_program_whose_lease_is_gone_when_it_has_started_is_waited_for() -> None:
    """Regression: vramctl ended with the error, and its program went on with nobody to pass signals
    to it."""
    arbiter = GrantsAtOnce(ready=LeaseLost("L1-1 expired"))
    async with (
        asyncio.timeout(WAIT_S),
        arbiter.serving() as endpoint,
        vramctl_run(endpoint) as process,
    ):
        await arbiter.refused.wait()
        process.send_signal(signal.SIGTERM)
        assert await process.wait() == 5
