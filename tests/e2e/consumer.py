"""A real consumer for the kill tests: one process, one lease, bytes on the simulated GPU. Not a
test module.

Usage: consumer.py NAME BYTES GPU_FOLDER RESIDUE_BYTES. Prints one JSON line per thing that
happens; commands come on stdin: `use`, `end`. Steps at which it stops and waits to be killed are
given by VRAM_TEST_PAUSE (comma-separated: `loading`, `unloading`).
"""

import asyncio
import contextlib
import os
import sys
from pathlib import Path

from tests.support.saying import say
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory
from vram_arbiter.sidecars.device.memory import Block

# a daemon that is started again on a busy machine is away for seconds, and nobody is to fence
# himself
TTL_S = 120.0
PAUSE = frozenset(os.environ.get("VRAM_TEST_PAUSE", "").split(","))


async def pause(step: str) -> None:
    say(step)
    if step in PAUSE:
        await asyncio.Event().wait()


async def commands() -> asyncio.StreamReader:
    reader = asyncio.StreamReader()
    await asyncio.get_running_loop().connect_read_pipe(
        lambda: asyncio.StreamReaderProtocol(reader), sys.stdin
    )
    return reader


async def main(name: str, size: int, gpu_folder: Path, residue: int) -> None:
    memory = FakeMemory(gpu_folder, name, residue)
    blocks: list[Block] = []

    async def unload() -> None:
        await pause("unloading")
        for block in blocks:
            memory.free(block)
        blocks.clear()
        memory.empty_cache()

    async def lost(_: AsyncLease, error: Exception) -> None:
        say("lost", error=str(error))

    spec = LeaseSpec(
        consumer=name, model_id=name, ttl_s=TTL_S, min_residency_s=0.0,
        footprint=Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=residue),
    )  # fmt: skip
    reader = await commands()
    async with AsyncClient(
        name=name, connect_timeout_s=60.0
    ) as client:  # the arbiter may be starting still
        say("waiting", pid=os.getpid())
        lease = await client.acquire(spec, unload=unload, on_lost=lost)
        say("granted", lease_id=lease.lease_id, token=list(lease.token))
        await pause("loading")
        blocks.append(memory.allocate(name, size - residue))
        await lease.ready(memory.used_bytes())
        say("ready")
        async with contextlib.AsyncExitStack() as uses:
            while line := await reader.readline():
                match line.strip():
                    case b"use":
                        await uses.enter_async_context(lease.use("test"))
                        say("in_use")
                    case b"end":
                        await uses.aclose()
                        say("idle")
                    case other:
                        raise SystemExit(f"unknown command {other!r}")


if __name__ == "__main__":
    asyncio.run(main(sys.argv[1], int(sys.argv[2]), Path(sys.argv[3]), int(sys.argv[4])))
