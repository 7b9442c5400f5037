"""The residency itself, in this process, beside the real daemon: what happens between two steps of
it that no other process can hit."""

import asyncio
from contextlib import asynccontextmanager

import pytest

from tests.sidecars.conftest import MANIFEST
from tests.support.waiting import eventually
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.errors import Evicted, ModelError, NotPermitted, NotResident
from vram_arbiter.schemas.manifest import parse_manifest
from vram_arbiter.schemas.wire.spec import Footprint
from vram_arbiter.sidecars.gpu_copy import TRANSITIONS
from vram_arbiter.sidecars.residency import Residency
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights import Weights

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

GB = 10**9
WAIT_S = 60.0


class Model:
    """A residency without a process. Counts its loads; one lasts until it `may_load`."""

    def __init__(self, box):
        self._box = box
        self.ended = asyncio.Event()

    async def load(self, gpu):
        self._box.loads += 1
        loaded = asyncio.create_task(self._box.may_load.wait())
        died = asyncio.create_task(self.ended.wait())
        await asyncio.wait({loaded, died}, return_when=asyncio.FIRST_COMPLETED)
        for waiting in (loaded, died):
            waiting.cancel()
        if self.ended.is_set():
            raise ModelError("the model's process ended by SIGKILL")
        return GB

    async def run(self, call, *, begin_s, end_s, begins):
        begins()
        if call == "die":
            self.ended.set()
            raise ModelError("the model's process ended by SIGKILL")
        return {"answer": call}

    async def end(self, *, at_once=False):
        self.ended.set()


class Models:
    """Starts them. Counts how often the weights, of so many bytes, were read into host RAM."""

    def __init__(self, weights_bytes=0):
        self.weights_bytes = weights_bytes
        self.in_host_ram = False
        self.reads = self.loads = 0
        self.started = []
        self.may_load = asyncio.Event()
        self.may_load.set()

    async def prepare(self):
        pass

    async def load(self):
        self.reads += not self.in_host_ram
        self.in_host_ram = True
        return self.weights_bytes

    async def start(self):
        self.started.append(Model(self))
        return self.started[-1]

    async def drop(self):
        self.in_host_ram = False

    async def end(self):
        self.in_host_ram = False


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
    manifest = parse_manifest(MANIFEST.format(name="eye"))
    return Settings(
        "eye", manifest, Weights("test/eye", local=False), footprint, "ipc://nobody",
        f"fake:{daemon.gpu_folder}", daemon.endpoint
    )  # fmt: skip


@asynccontextmanager
async def residing(daemon, models):
    """A residency of these models, and its client; it leaves at the end."""
    async with Client(daemon.endpoint) as client, asyncio.timeout(WAIT_S):
        residency = Residency(settings(daemon), models, client)
        yield residency, client
        await residency.leave()


async def test_an_unload_between_the_grant_and_the_load_is_heard(arbiter_daemon):
    """Regression: the wait was over and the lease not taken yet, so there was nothing to give up,
    and the model was loaded."""
    models = Models()
    async with residing(arbiter_daemon, models) as (residency, client):
        client.at_the_grant = residency.unload
        with pytest.raises(NotResident):
            await residency.load()
        await client.done
        assert (models.loads, residency.state, residency.token()) == (0, "unloaded", None)
        while (await client.status()).leases:
            await asyncio.sleep(0.02)
        assert await residency.load(), "the next request asks anew"
        assert (models.loads, residency.state) == (1, "resident")


async def test_an_unload_without_an_arbiter_is_heard_in_the_middle_of_a_load_too(arbiter_daemon):
    """Regression: there was no lease to give up and nothing resident to unload yet, so it was
    answered and the model stayed."""
    models = Models()
    residency = Residency(settings(arbiter_daemon), models, None)
    models.may_load.clear()
    async with asyncio.timeout(WAIT_S):
        loading = asyncio.create_task(residency.load())
        await eventually(lambda: models.loads)
        await residency.unload()
        with pytest.raises(NotResident):
            await loading
        assert (models.loads, residency.state) == (1, "unloaded")
        await residency.leave()


async def test_each_residency_has_a_model_of_its_own(arbiter_daemon):
    models = Models()
    async with residing(arbiter_daemon, models) as (residency, _):
        await residency.load()
        await residency.unload()
        assert models.started[0].ended.is_set()
        await residency.load()
        assert len(models.started) == 2
        assert not models.started[1].ended.is_set()
    assert models.started[1].ended.is_set()


async def test_a_model_that_is_wanted_soon_is_read_ahead_and_nothing_else(
    arbiter_daemon, monkeypatch
):
    """The hint reaches the consumer by its name. It asks for no lease, and weights for which no
    request comes, or no host RAM is left, do not stay."""
    models = Models(weights_bytes=GB)
    endpoint = arbiter_daemon.endpoint
    async with (
        AsyncClient("eye", endpoint=endpoint) as client,
        AsyncClient("reasoner", endpoint=endpoint) as reasoner,
        AsyncClient("watcher", endpoint=endpoint, role="observer") as watcher,
        asyncio.timeout(WAIT_S),
    ):
        residency = Residency(settings(arbiter_daemon), models, client)
        client.on_prepare(residency.announce)
        with pytest.raises(NotPermitted):
            await watcher.prepare("eye")
        assert (await reasoner.prepare("nobody")).told == 0
        for _ in range(2):
            assert (await reasoner.prepare("eye")).told == 1
        await eventually(lambda: models.in_host_ram)
        assert (models.reads, models.loads, (await client.status()).leases) == (1, 0, ())
        await residency.load()
        assert (models.reads, residency.state) == (1, "resident"), "it was there already"
        await residency.unload()
        await eventually(lambda: not models.in_host_ram)
        await reasoner.prepare("eye")
        # regression: the second hint in two minutes was ignored
        await eventually(lambda: models.in_host_ram)
        await residency.leave()

        monkeypatch.setattr("vram_arbiter.sidecars.host_copy.FORESEEN_S", 0.0)
        again = Residency(settings(arbiter_daemon), models, client)
        again.announce("reasoner")
        await eventually(lambda: models.reads == 3 and not models.in_host_ram)
        scarce = Models(weights_bytes=GB)
        crowded = Residency(settings(arbiter_daemon), scarce, client)
        crowded._host.size_bytes = (await client.status()).host_ram.budget_bytes + 1
        crowded.announce("reasoner")
        await crowded._host._foreseen
        assert scarce.reads == 0
        for residency in (again, crowded):
            await residency.leave()


async def test_weights_of_a_model_that_died_stay_for_the_next_request(arbiter_daemon):
    """Regression: they were dropped, and the next request read all of them again. Where the budget
    of host RAM has no room for them they do go."""
    models = Models(weights_bytes=GB)
    async with residing(arbiter_daemon, models) as (residency, client):
        await residency.load()
        models.started[0].ended.set()
        await eventually(lambda: residency.state == "unloaded")
        await residency.load()
        assert (models.reads, residency.state) == (1, "resident")
        residency._host._expected_bytes = (await client.status()).host_ram.budget_bytes + 1
        models.started[1].ended.set()
        await eventually(lambda: not models.in_host_ram)


async def test_weights_stay_in_host_ram_while_the_arbiter_has_room_for_them(arbiter_daemon):
    """A parked model comes back without reading its weights again, and an unload frees them."""
    models = Models(weights_bytes=GB)
    async with residing(arbiter_daemon, models) as (residency, client):
        assert await residency.load()
        await parked_for_another(residency, arbiter_daemon.endpoint)
        assert models.started[0].ended.is_set()
        assert (await residency.run("detect", None, "look"))["answer"] == "look"
        assert (residency.state, models.reads, models.loads) == ("resident", 1, 2)
        await parked_for_another(residency, arbiter_daemon.endpoint)
        await residency.unload()
        assert residency.state == "unloaded"
        while models.in_host_ram or (await client.status()).leases:
            await asyncio.sleep(0.02)
        assert await residency.load()
        assert models.reads == 2


async def parked_for_another(residency, endpoint):
    """Have the model evicted; the other one leaves again at once."""
    async with AsyncClient("other", endpoint=endpoint) as other, other.lease(vram=8 * GB):
        view = (await other.status()).leases[0]
        assert (residency.state, view.state, view.parked_bytes) == ("parked", "parked", GB)


async def test_weights_leave_host_ram_where_the_arbiter_has_no_room_for_them(make_arbiter):
    """They would lie there unaccounted as long as the model is resident."""
    arbiter = make_arbiter(config="host: {park_budget_bytes: 1MB}")
    arbiter.start()
    models = Models(weights_bytes=GB)
    async with residing(arbiter, models) as (residency, _):
        assert await residency.load()
        await eventually(lambda: not models.in_host_ram)
        other = AsyncClient("other", endpoint=arbiter.endpoint)
        async with other, other.lease(vram=8 * GB):
            assert residency.state == "unloaded"
        assert await residency.load()
        assert models.reads == 2


async def test_an_idle_model_is_parked(arbiter_daemon):
    models = Models(weights_bytes=GB)
    async with residing(arbiter_daemon, models) as (residency, _):
        await residency.load()
        idle = asyncio.create_task(residency.release_when_idle(0.0))
        await eventually(lambda: residency.state == "parked")
        idle.cancel()
        assert models.in_host_ram
        assert await residency.load()
        assert models.reads == 1


async def test_a_model_that_dies_ends_its_lease_and_the_next_request_loads_another(arbiter_daemon):
    models = Models()
    async with residing(arbiter_daemon, models) as (residency, client):
        with pytest.raises(ModelError, match="SIGKILL"):
            await residency.run("detect", None, "die")
        while residency.state != "unloaded" or (await client.status()).leases:
            await asyncio.sleep(0.02)
        assert residency.last_error.code == "model_error"
        assert (await residency.run("detect", None, "look"))["answer"] == "look"


async def test_a_request_behind_an_unload_is_evicted_not_answered(arbiter_daemon):
    """Regression: an op that was queued before an unload ran after it."""
    models = Models()
    async with residing(arbiter_daemon, models) as (residency, _):
        await residency.load()
        token = residency.token()
        await residency.unload()
        with pytest.raises(Evicted):
            await residency.run("detect", token, "look")


def test_every_state_can_be_reached_and_left():
    assert set().union(*TRANSITIONS.values()) == TRANSITIONS.keys()
    assert all(TRANSITIONS.values())
