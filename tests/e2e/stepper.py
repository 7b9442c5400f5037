"""A consumer that stops at every step of its life and goes on when it is told `go`. Not a test
module; run by `tests.support.children`.

Arguments: NAME BYTES GPU_FOLDER RESIDUE_BYTES. It says `waiting`, `loading`, `ready`, `in_use`,
`unloading`, `released`; it waits for `go` after `loading`, `in_use` and `unloading`. `use` begins a
use, which the next `go` ends.
"""

import asyncio
import sys
from pathlib import Path

from tests.support.saying import say, told_lines
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory

# a daemon that is started again on a busy machine is away for seconds, and nobody is to fence
# himself
TTL_S = 120.0


async def live(name: str, size: int, gpu_folder: Path, residue: int) -> None:
    reader = await told_lines()
    told: asyncio.Queue[str] = asyncio.Queue()

    async def listen() -> None:
        while line := await reader.readline():
            told.put_nowait(line.decode().strip())

    async def go() -> None:
        while await told.get() != "go":
            pass

    listening = asyncio.ensure_future(listen())
    memory = FakeMemory(gpu_folder, name, residue)
    block = None

    async def unload() -> None:
        say("unloading")
        await go()
        if block is not None:
            memory.free(block)
        memory.empty_cache()

    spec = LeaseSpec(
        consumer=name, model_id=name, ttl_s=TTL_S, min_residency_s=0.0,
        footprint=Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=residue),
    )  # fmt: skip
    async with AsyncClient(name=name, connect_timeout_s=60.0) as client:
        say("waiting")
        lease = await client.acquire(spec, unload=unload)
        say("loading", lease_id=lease.lease_id, token=list(lease.token))
        await go()
        block = memory.allocate(name, size - residue)
        await lease.ready(memory.used_bytes())
        say("ready")
        using = asyncio.ensure_future(told.get())
        gone = asyncio.ensure_future(lease.wait_gone())
        await asyncio.wait([using, gone], return_when=asyncio.FIRST_COMPLETED)
        if using.done() and using.result() == "use":
            async with lease.use("work"):
                say("in_use")
                await go()
            say("idle")
        elif using.done():
            told.put_nowait(using.result())  # a `go` for the unloading, said early
        else:
            using.cancel()
        await gone
        say("released")
        await listening


def main() -> None:
    name, size, gpu_folder, residue = sys.argv[1:]
    asyncio.run(live(name, int(size), Path(gpu_folder), int(residue)))
