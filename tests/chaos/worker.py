"""What a process of the storm does: a consumer that leases and loads for ever, a stranger that
takes bytes without asking, or a user that marks uses on other people's leases. Not a test module;
run by `tests.support.children`.

A consumer writes down what it does, and when, in a trace of JSON lines: the checker's second
witness beside the arbiter's history. It is honest but not careful: it loads after its grant without
looking twice, as real programs do.
"""

import asyncio
import contextlib
import json
import os
import random
import signal
import sys
import time
from collections.abc import Coroutine
from pathlib import Path
from typing import Any

from tests.support.attacks import ATTACKS
from tests.support.saying import say, told_lines
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.fakegpu import SimulatedOutOfMemory
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory
from vram_arbiter.sidecars.device.memory import Block

CHUNKS = 3
LOAD_S, UNLOAD_S, USE_S, IDLE_S = 0.05, 0.03, 0.12, 0.1
"""Longest pauses. A step has to last long enough for a fault to meet it."""
RETRY_S = 0.5  # where the arbiter has a disk that is full
CONNECT_S = 60.0


class Trace:
    """One line per fact, written in one `write` each: a kill loses whole lines only."""

    def __init__(self, path: Path, name: str) -> None:
        self._file = os.open(path, os.O_WRONLY | os.O_APPEND | os.O_CREAT, 0o600)
        self._name = name

    def say(self, event: str, **facts: object) -> None:
        line = {
            "t": time.monotonic(),
            "pid": os.getpid(),
            "name": self._name,
            "event": event,
            **facts,
        }
        os.write(self._file, (json.dumps(line) + "\n").encode())


class Consumer:
    """One process with one lease at a time."""

    def __init__(self, name: str, seed: str, gpu_folder: Path, trace: Trace) -> None:
        self._name = name
        self._random = random.Random(f"{name} {seed}")
        self._trace = trace
        self._residue = self._random.choice([128, 256, 450]) * MIB
        self._memory = FakeMemory(gpu_folder, name, self._residue)
        self._stopping = asyncio.Event()

    async def run(self) -> None:
        asyncio.get_running_loop().add_signal_handler(signal.SIGTERM, self._stopping.set)
        async with AsyncClient(name=self._name, connect_timeout_s=CONNECT_S) as client:
            while not self._stopping.is_set():
                await self._round(client)
        self._memory.close()
        self._trace.say("done")

    def _spec(self) -> LeaseSpec:
        draw = self._random
        steady = draw.choice([500, 700, 1200, 2000, 3000, 4500]) * MIB
        peak = int(steady * draw.choice([1.0, 1.0, 1.2]))
        return LeaseSpec(
            consumer=self._name,
            model_id=f"{self._name}-{steady}",
            ttl_s=3.0,
            min_residency_s=draw.choice([0.0, 0.2, 0.4]),
            mode=draw.choice(["shared", "shared", "shared", "exclusive"]),
            priority=draw.choice([40, 50, 50, 60]),
            footprint=Footprint(
                load_peak_bytes=peak, steady_bytes=steady, residue_bytes=self._residue
            ),
        )

    async def _round(self, client: AsyncClient) -> None:
        """Acquire, load, use, leave. Whatever goes wrong ends the round, never the process."""
        spec = self._spec()
        blocks: list[Block] = []
        say = self._trace.say

        async def unload() -> None:
            say("unload", lease_id=lease_id)
            await self._free(blocks)
            say("unloaded", lease_id=lease_id)

        async def lost(lease: AsyncLease, error: VramError) -> None:
            say("lost", lease_id=lease.lease_id, code=error.code)

        lease_id = ""
        say(
            "asked",
            bytes=spec.footprint.load_peak_bytes,
            exclusive=spec.mode == "exclusive",
            residue_bytes=self._residue,
        )
        try:
            lease = await self._unless_stopping(
                client.acquire(
                    spec, self._random.choice([None, None, 5.0, 20.0]), unload=unload, on_lost=lost
                )
            )
        except VramError as error:
            say("denied", code=error.code)
            await self._pause(IDLE_S if error.code != "journal_unavailable" else RETRY_S)
            return
        if lease is None:
            say("gave_up")
            return
        lease_id = lease.lease_id
        say(
            "granted",
            lease_id=lease_id,
            token=list(lease.token),
            exclusive=spec.mode == "exclusive",
            bytes=spec.footprint.load_peak_bytes,
        )
        try:
            await self._load(lease, spec, blocks)
            await self._use(lease)
        except SimulatedOutOfMemory as error:
            say("oom", lease_id=lease_id, requested_bytes=error.details["requested_bytes"])
            with contextlib.suppress(VramError):
                used_bytes = await asyncio.to_thread(self._memory.used_bytes)
                await lease.oom(int(error.details["requested_bytes"]), used_bytes)
        except VramError as error:
            say("refused", lease_id=lease_id, code=error.code)
        finally:
            await lease.give_up()
            await self._free(blocks)
            say("over", lease_id=lease_id)

    async def _load(self, lease: AsyncLease, spec: LeaseSpec, blocks: list[Block]) -> None:
        """In pieces, up to the peak and down again, as real loaders do."""
        peak = spec.footprint.load_peak_bytes - self._residue
        extra = spec.footprint.load_peak_bytes - spec.footprint.steady_bytes
        for _ in range(CHUNKS):
            if lease.state not in ("loading", "revoking"):
                return
            blocks.append(await self._allocate(lease, (peak - extra) // CHUNKS))
            await self._pause(LOAD_S / CHUNKS)
        if extra:
            scratch = [await self._allocate(lease, extra)]
            await self._free(scratch)
        await lease.ready(await asyncio.to_thread(self._memory.used_bytes))
        self._trace.say("ready", lease_id=lease.lease_id)

    async def _allocate(self, lease: AsyncLease, size: int) -> Block:
        """Off the loop, as real loaders do: the GPU's lock may be held by a process that was
        stopped."""
        return await asyncio.to_thread(self._memory.allocate, lease.lease_id, size)

    async def _unless_stopping(self, work: Coroutine[Any, Any, AsyncLease]) -> AsyncLease | None:
        """What the work gives; None if this process is to stop first."""
        task = asyncio.ensure_future(work)
        stop = asyncio.ensure_future(self._stopping.wait())
        await asyncio.wait([task, stop], return_when=asyncio.FIRST_COMPLETED)
        stop.cancel()
        if task.done():
            return task.result()
        task.cancel()
        with contextlib.suppress(asyncio.CancelledError):
            await task
        return None

    async def _use(self, lease: AsyncLease) -> None:
        for _ in range(self._random.randint(1, 4)):
            if self._stopping.is_set():
                return
            async with lease.use("storm"):
                self._trace.say("in_use", lease_id=lease.lease_id)
                await self._pause(USE_S)
                self._trace.say("idle", lease_id=lease.lease_id)
            await self._pause(IDLE_S)
        with contextlib.suppress(TimeoutError):
            await asyncio.wait_for(lease.wait_gone(), self._random.uniform(0.0, 1.0))

    async def _free(self, blocks: list[Block]) -> None:
        await self._pause(UNLOAD_S)
        while blocks:
            await asyncio.to_thread(self._memory.free, blocks.pop())
        await asyncio.to_thread(self._memory.empty_cache)

    async def _pause(self, longest_s: float) -> None:
        await asyncio.sleep(self._random.uniform(longest_s / 3, longest_s))


async def take_bytes(gpu_folder: Path, trace: Trace, size: int) -> None:
    """A stowaway: allocates without a lease, and exits when it is told to or its standard input
    ends."""
    memory = FakeMemory(gpu_folder, "stowaway", 64 * MIB)
    try:
        memory.allocate("stowaway", size)
        trace.say("took", bytes=size)
    except SimulatedOutOfMemory:
        trace.say("no_room", bytes=size)
    say("took")
    await (await told_lines()).readline()
    memory.close()
    trace.say("done")


async def mark_uses(trace: Trace) -> None:
    """Like a runner: marks a use on the lease of whoever it is told of (`LEASE EPOCH SERIAL`), by
    its token."""
    reader = await told_lines()
    async with AsyncClient(name="user", connect_timeout_s=CONNECT_S) as client:
        while line := await reader.readline():
            lease_id, epoch, serial = line.decode().split()
            try:
                async with client.use(lease_id, (int(epoch), int(serial)), "goal"):
                    trace.say("foreign_use", lease_id=lease_id)
                    await asyncio.sleep(USE_S)
                    trace.say("foreign_idle", lease_id=lease_id)
            except VramError as error:
                trace.say("refused", lease_id=lease_id, code=error.code)
    trace.say("done")


def main() -> None:
    """`consumer NAME SEED GPU_FOLDER TRACES`, `stowaway NAME BYTES GPU_FOLDER TRACES`,
    `user NAME - GPU_FOLDER TRACES` or `attacker NAME ATTACK:SECONDS GPU_FOLDER TRACES`."""
    kind, name, what, gpu_folder, traces = sys.argv[1:]
    trace = Trace(Path(traces) / f"{name}.jsonl", name)
    trace.say("born", kind=kind)
    try:
        match kind:
            case "consumer":
                asyncio.run(Consumer(name, what, Path(gpu_folder), trace).run())
            case "stowaway":
                asyncio.run(take_bytes(Path(gpu_folder), trace, int(what)))
            case "attacker":
                attack, seconds = what.split(":")
                endpoint = arbiter_endpoint(os.environ, os.getuid())
                ATTACKS[attack](endpoint.removeprefix("ipc://"), time.monotonic() + float(seconds))
            case _:
                asyncio.run(mark_uses(trace))
    except BaseException as error:
        trace.say("crashed", error=repr(error))
        raise
