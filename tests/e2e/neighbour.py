"""A consumer with the habits that users of the neighbours complain about. Not a test module; run by
`tests.support.children`.

Arguments: NAME BYTES GPU_FOLDER HABITS (JSON). It says `waiting`, `loading`, `ready`, `unloading`,
`gone`. Habits: `slow` loads when it is told `go`, `stuck` never ends its unloading, `deaf` ignores
SIGTERM, `again` asks for its lease again in the very moment it has lost it, `spec` goes into its
lease.
"""

import asyncio
import json
import signal
import sys
from pathlib import Path
from typing import Any

from tests.support.saying import say, told_lines
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory
from vram_arbiter.sidecars.device.memory import Block

RESIDUE = 256 << 20
TTL_S = 120.0  # one that is stopped for a while, on a busy machine, has its lease still


async def live(name: str, size: int, gpu_folder: Path, habits: dict[str, Any]) -> None:
    reader = await told_lines()
    memory = FakeMemory(gpu_folder, name, RESIDUE)
    blocks: list[Block] = []

    async def unload() -> None:
        say("unloading")
        if habits.get("stuck"):
            await asyncio.Event().wait()
        for block in blocks:
            memory.free(block)
        blocks.clear()
        memory.empty_cache()

    footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=RESIDUE)
    spec = LeaseSpec(
        consumer=name,
        model_id=name,
        footprint=footprint,
        **({"min_residency_s": 0.0, "ttl_s": TTL_S} | habits.get("spec", {})),
    )
    async with AsyncClient(name=name, connect_timeout_s=60.0) as client:
        for _ in range(2 if habits.get("again") else 1):
            say("waiting")
            lease = await client.acquire(spec, unload=unload)
            say("loading")
            if habits.get("slow"):
                await reader.readline()
            blocks.append(memory.allocate(name, size - RESIDUE))
            await lease.ready(memory.used_bytes())
            say("ready")
            await lease.wait_gone()
            say("gone")
        while await reader.readline():
            pass


def main() -> None:
    name, size, gpu_folder, habits = sys.argv[1:]
    wanted = json.loads(habits)
    if wanted.get("deaf"):
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
    asyncio.run(live(name, int(size), Path(gpu_folder), wanted))
