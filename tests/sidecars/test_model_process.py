"""Processes of one model: forked from a server of imports, asked in turn, ended."""

import asyncio
import functools
import multiprocessing
import os
import signal
import tempfile
from collections.abc import AsyncIterator, Iterator
from multiprocessing import forkserver
from pathlib import Path

import pytest

from tests.sidecars.conftest import MANIFEST, PNG
from tests.sidecars.echo_sidecar import echo_for
from tests.support.matrix_model import matrix_for
from tests.support.waiting import eventually, until
from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu
from vram_arbiter.schemas.errors import BadRequest, ModelError, OutOfMemory, WaitTimeout
from vram_arbiter.schemas.manifest import parse_manifest
from vram_arbiter.schemas.wire.spec import Footprint
from vram_arbiter.sidecars.adapters.base import LEROBOT
from vram_arbiter.sidecars.model_main import AdapterFor
from vram_arbiter.sidecars.model_process import ModelProcess
from vram_arbiter.sidecars.settings import Settings
from vram_arbiter.sidecars.weights import Weights
from vram_arbiter.sidecars.weights_keeper import ModelProcesses

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

GB = 10**9
MATRIX_BYTES = 64 * 2**20
WAIT_S = 60.0


class Place:
    """A simulated GPU, and a folder that tells the model what to do."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.gpu_folder = folder / "fakegpu"
        make_gpu(self.gpu_folder, 8 * 2**30, release_lag_s=0.01)
        self.made: list[ModelProcesses] = []

    def processes(self, steady: int = GB, adapter: AdapterFor | None = None) -> ModelProcesses:
        footprint = Footprint(load_peak_bytes=steady, steady_bytes=steady, residue_bytes=GB // 10)
        settings = Settings(
            "eye", parse_manifest(MANIFEST.format(name="eye")), Weights("test/eye"), footprint,
            f"ipc://{self.folder}/eye.sock", f"fake:{self.gpu_folder}", None
        )  # fmt: skip
        echo = functools.partial(echo_for, self.folder)
        made = ModelProcesses(settings, adapter or echo, no_log)
        self.made.append(made)
        return made

    async def start(self, steady: int = GB) -> ModelProcess:
        return await self.processes(steady).start()

    def used(self) -> int:
        probe = FakeProbe([self.gpu_folder])
        return probe.sample(probe.gpus()[0].id).used_bytes


@pytest.fixture(autouse=True, scope="module")
def _server() -> Iterator[None]:
    """This process's server of imports has a temporary folder that goes with these tests."""
    config = multiprocessing.current_process()._config  # type: ignore[attr-defined]
    with tempfile.TemporaryDirectory(prefix="vs") as folder:
        config["tempdir"] = folder
        yield
        forkserver._forkserver._stop()  # type: ignore[attr-defined]
        del config["tempdir"]


@pytest.fixture
async def place(tmp_path: Path) -> AsyncIterator[Place]:
    place = Place(tmp_path)
    yield place
    for processes in place.made:
        await processes.end()


def no_log() -> None:
    """Leave the log as it is."""


def detect_op(query: str) -> dict[str, object]:
    return {"op": "detect", "image": PNG, "query": query}


async def answer_of(model, query: str, begin_s: float = WAIT_S, end_s: float = WAIT_S):
    reply = await model.run(detect_op(query), begin_s=begin_s, end_s=end_s, begins=lambda: None)
    return reply["answer"]


async def test_its_end_returns_every_byte(place: Place) -> None:
    async with asyncio.timeout(WAIT_S):
        model = await place.start()
        assert place.used() == 0, "a process has nothing on the GPU before its load"
        assert await model.load("") == GB
        assert (await answer_of(model, "cube"))["answer"] == "cube"
        await model.end()
        await model.end()
        assert model.ended.is_set()
    until(lambda: place.used() == 0)


async def test_errors_keep_their_type(place: Place) -> None:
    async with asyncio.timeout(WAIT_S):
        model = await place.start(steady=9 * GB)
        with pytest.raises(OutOfMemory, match="simulated"):
            await model.load("")
        await model.end()
        model = await place.start()
        await model.load("")
        with pytest.raises(ModelError, match="RuntimeError: the model fails as told"):
            await answer_of(model, "fail")
        with pytest.raises(BadRequest, match="not like that"):
            await answer_of(model, "refuse")
        assert (await answer_of(model, "cube"))["answer"] == "cube", "it lives on"
        await model.end()


async def test_a_request_that_could_not_begin_in_time_never_does(place: Place) -> None:
    """Regression: a request behind one that hung in a decoder kept its use of the lease for
    ever."""
    async with asyncio.timeout(WAIT_S):
        model = await place.start()
        await model.load("")
        hanging = asyncio.create_task(answer_of(model, "hold go"))
        await eventually((place.folder / "holding").exists)
        with pytest.raises(WaitTimeout, match="busy"):
            await answer_of(model, "late", begin_s=0.05)
        canceled = asyncio.create_task(answer_of(model, "x"))
        await asyncio.sleep(0)
        canceled.cancel()
        with pytest.raises(asyncio.CancelledError):
            await canceled
        (place.folder / "go").touch()
        assert (await hanging)["answer"] == "hold go"
        assert (await answer_of(model, "next"))["answer"] == "next"
        await model.end()


async def test_a_request_that_does_not_end_is_ended_with_its_process(place: Place) -> None:
    async with asyncio.timeout(WAIT_S):
        model = await place.start()
        await model.load("")
        with pytest.raises(ModelError, match="has not answered within"):
            await answer_of(model, "hold for ever", end_s=0.2)
        await model.ended.wait()
        with pytest.raises(ModelError, match="ended by SIGKILL"):
            await answer_of(model, "next")
    until(lambda: place.used() == 0)


async def test_a_caller_that_turns_away_leaves_the_model_in_order(place: Place) -> None:
    """The answer of a canceled request is not taken for the next one's."""
    async with asyncio.timeout(WAIT_S):
        model = await place.start()
        await model.load("")
        turning_away = asyncio.create_task(answer_of(model, "hold go"))
        await eventually((place.folder / "holding").exists)
        turning_away.cancel()
        await asyncio.sleep(0)
        (place.folder / "go").touch()
        with pytest.raises(asyncio.CancelledError):
            await turning_away
        assert (await answer_of(model, "next"))["answer"] == "next"
        await model.end()


async def test_a_load_that_is_not_wanted_any_more_is_ended_at_once(place: Place) -> None:
    (place.folder / "slow_load").touch()
    async with asyncio.timeout(WAIT_S):
        model = await place.start()
        loading = asyncio.create_task(model.load(""))
        await eventually(place.used)
        await model.end(at_once=True)
        with pytest.raises(ModelError, match="ended by SIGKILL"):
            await loading
    until(lambda: place.used() == 0)


async def test_the_keeper_may_die_and_the_next_one_begins_anew(place: Place) -> None:
    """A model process ends with its keeper: the arbiter knows its bytes by the tree of processes
    that it stands in."""
    processes = place.processes()
    async with asyncio.timeout(WAIT_S):
        model = await processes.start()
        await model.load("")
        os.kill(parent(model.pid), signal.SIGKILL)
        await model.ended.wait()
        until(lambda: place.used() == 0)
        (place.folder / "fail_read").touch()
        with pytest.raises(ModelError, match="read fails as told"):
            await processes.load()
        (place.folder / "fail_read").unlink()
        model = await processes.start()
        assert await model.load("") == GB
        await model.end()


@pytest.mark.heavy
@pytest.mark.nightly  # it imports torch and lerobot once more
async def test_the_keeper_has_one_thread_and_no_device_before_each_fork(place: Place) -> None:
    """A fork copies one thread only: locks that others hold would stay locked. A CUDA context does
    not survive a fork at all. The weights are in host RAM once, whatever is forked."""
    forkserver._forkserver._stop()  # type: ignore[attr-defined]  # the next one imports these
    processes = place.processes(adapter=functools.partial(matrix_for, MATRIX_BYTES))
    processes.preload(("torch", "transformers", LEROBOT))
    async with asyncio.timeout(4 * WAIT_S):
        assert await processes.load() == GB, "the weights stand for those of a production model"
        answers = []
        for _ in range(2):
            model = await processes.start()
            await model.load("")
            answers.append(await answer_of(model, "sum"))
            keeper = parent(model.pid)
            threads = os.listdir(f"/proc/{keeper}/task")
            opened = [os.readlink(one) for one in Path(f"/proc/{keeper}/fd").iterdir()]
            shared = shared_bytes(keeper)
            await model.end()
        server = parent(keeper)
        maps = Path(f"/proc/{server}/maps").read_text()
        assert os.listdir(f"/proc/{server}/task") == [str(server)]
        await processes.drop()
        dropped = shared_bytes(keeper)
        await processes.end()
    assert answers[0] == answers[1], "each process copied the same weights"
    assert "libtorch" in maps, "imported for all"
    assert "bitsandbytes" not in maps, "its import initializes CUDA"
    assert threads == [str(keeper)]
    assert not [name for name in opened if "nvidia" in name]
    assert (shared, dropped) == (MATRIX_BYTES, 0)


def parent(pid: int) -> int:
    return int(Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[1])


def shared_bytes(pid: int) -> int:
    """Size of the memory that a process shares for weights."""
    spans = [
        line.split()[0].split("-")
        for line in Path(f"/proc/{pid}/maps").read_text().splitlines()
        if "/memfd:weights" in line
    ]
    return sum(int(end, 16) - int(begin, 16) for begin, end in spans)
