"""The residency itself, in this process, beside the real daemon: what happens between two steps of
it that no other process can hit."""

import asyncio
import threading

import pytest

from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import NotResident
from vram_arbiter.schemas.manifest import parse_manifest
from vram_arbiter.schemas.wire.requests import Footprint
from vram_arbiter.sidecars.device.fake import FakeMemory
from vram_arbiter.sidecars.residency import Residency
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights import Weights
from vram_arbiter.sidecars.worker import Worker

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

GB = 10**9
WAIT_S = 60.0
MANIFEST = """
name: test/eye
version: 0.1.0
kind: detector
embodiment_tags: [any]
chunk_size: 1
weights_uri: hf://test/eye
description: sees nothing
latency_budget: {per_chunk_ms: 100}
actions: [detect]
detector: {labels: [cube]}
"""


class Model:
    """Counts its loads; one lasts until it `may_load`."""

    kind = "detector"
    ops = frozenset({"detect"})

    def __init__(self):
        self.loads = 0
        self.may_load = threading.Event()
        self.may_load.set()

    def prepare(self):
        pass

    def load(self, device):
        self.loads += 1
        assert self.may_load.wait(WAIT_S)

    def unload(self):
        pass

    def run(self, call):
        return {"ok": True}


class Client(AsyncClient):
    """Does something in the very moment in which a lease is granted, before whoever waits for it
    goes on."""

    def __init__(self, endpoint):
        super().__init__("eye", endpoint=endpoint)
        self.at_the_grant = None
        self.done = None

    async def acquire(self, *spec, **callbacks):
        lease = await super().acquire(*spec, **callbacks)
        if self.at_the_grant is not None:
            self.done = asyncio.create_task(self.at_the_grant())
            self.at_the_grant = None
        return lease


def settings(daemon):
    footprint = Footprint(load_peak_bytes=GB, steady_bytes=GB, residue_bytes=GB // 10)
    manifest = parse_manifest(MANIFEST)
    return Settings(
        "eye", manifest, Weights("test/eye", local=False), footprint, "ipc://nobody",
        f"fake:{daemon.card}", daemon.endpoint
    )  # fmt: skip


async def test_an_unload_between_the_grant_and_the_load_is_heard(arbiter_daemon):
    """Regression: the wait was over and the lease not taken yet, so there was nothing to give up,
    and the model was loaded."""
    worker, model = Worker(), Model()
    async with Client(arbiter_daemon.endpoint) as client, asyncio.timeout(WAIT_S):
        memory = FakeMemory(arbiter_daemon.card, "eye", GB // 10)
        residency = Residency(settings(arbiter_daemon), model, memory, worker, client)
        client.at_the_grant = residency.unload
        with pytest.raises(NotResident):
            await residency.load()
        await client.done
        assert (model.loads, residency.state, residency.token()) == (0, "unloaded", None)
        while (await client.status()).leases:
            await asyncio.sleep(0.02)
        assert await residency.load(), "the next request asks anew"
        assert (model.loads, residency.state) == (1, "resident")
        assert await residency.leave()
    worker.close()


class OneGpu(FakeMemory):
    """A process that stays on the GPU that it was granted first, as CUDA does."""

    def bind(self, gpu):
        return gpu


async def test_a_process_that_cannot_change_its_gpu_asks_for_that_one(arbiter_daemon):
    """A sidecar loaded on the first GPU whichever was granted."""
    daemon = arbiter_daemon
    worker = Worker()
    async with AsyncClient("eye", endpoint=daemon.endpoint) as client, asyncio.timeout(WAIT_S):
        memory = OneGpu(daemon.card, "eye", GB // 10)
        residency = Residency(settings(daemon), Model(), memory, worker, client)
        await residency.load()
        first = residency.lease
        assert first.spec.gpu == "any"
        await residency.unload()
        await residency.load()
        assert residency.lease.spec.gpu == residency.lease.gpu == first.gpu
        assert await residency.leave()
    worker.close()


async def test_an_unload_without_an_arbiter_is_heard_in_the_middle_of_a_load_too(arbiter_daemon):
    """Regression: there was no lease to give up and nothing resident to unload yet, so it was
    answered and the model stayed."""
    worker, model = Worker(), Model()
    memory = FakeMemory(arbiter_daemon.card, "eye", GB // 10)
    residency = Residency(settings(arbiter_daemon), model, memory, worker, None)
    model.may_load.clear()
    async with asyncio.timeout(WAIT_S):
        loading = asyncio.create_task(residency.load())
        while not model.loads:
            await asyncio.sleep(0.01)
        unloading = asyncio.create_task(residency.unload())
        await asyncio.sleep(0)  # it has begun
        model.may_load.set()
        await unloading
        with pytest.raises(NotResident):
            await loading
        assert (model.loads, residency.state) == (1, "unloaded")
        assert await residency.leave()
    worker.close()
