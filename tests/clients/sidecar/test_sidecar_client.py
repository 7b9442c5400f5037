"""Clients of sidecars against a real server process: lazy connection, typed errors, and servers
that die."""

import asyncio
import os
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator

import pytest

from tests.support import prepared
from tests.support.prepared import Forked
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import Detection, DetectorClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import (
    Evicted,
    Loading,
    ModelError,
    NotResident,
    OutOfMemory,
    SidecarUnavailable,
)
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sidecar import QueryOp

pytestmark = [pytest.mark.anyio, pytest.mark.e2e]

PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="sc") as folder:  # short: a socket path holds 107 bytes
        yield f"ipc://{folder}/s.sock"


type Start = Callable[[], Forked]


@pytest.fixture
def start_sidecar(endpoint: str) -> Iterator[Start]:
    """Start the sidecar."""
    started: list[Forked] = []

    def start() -> Forked:
        started.append(prepared.start("op-server", [endpoint], os.environ))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
async def detector(endpoint: str, start_sidecar: Start) -> AsyncIterator[DetectorClient]:
    start_sidecar()
    async with DetectorClient(endpoint, timeout_s=60.0, connect_timeout_s=60.0) as client:
        yield client


# -- life of a server
async def test_a_sidecar_that_starts_is_waited_for_and_left_running(
    endpoint: str, start_sidecar: Start
) -> None:
    process = start_sidecar()
    client = DetectorClient(endpoint, connect_timeout_s=60.0)
    found = await client.detect(PNG, "red cube")
    assert found == [Detection("b", 0.9, (1, 1, 3, 3)), Detection("a", 0.2, (0, 0, 2, 4))]
    assert found[1].centre == (1.0, 2.0)
    assert client.identity["pid"] == process.pid
    await client.close()
    assert process.poll() is None
    await client.close()


async def test_a_dead_sidecar_is_reported_at_once_and_its_successor_used(
    endpoint: str, start_sidecar: Start
) -> None:
    """Its successor starts once the process has ended: the kernel may close the connection before
    the lock of the socket, and the successor would end with "already uses"."""
    first = start_sidecar()
    async with DetectorClient(endpoint, timeout_s=60.0, connect_timeout_s=60.0) as detector:
        await detector.detect(PNG, "x")
        with pytest.raises(SidecarUnavailable, match="hung up"):
            await detector.detect(PNG, "die")
        assert first.wait(60.0) == 9
        second = start_sidecar()
        await detector.detect(PNG, "x")
        assert detector.identity["pid"] == second.pid


async def test_nobody_there(endpoint: str) -> None:
    async with SidecarClient(endpoint, connect_timeout_s=0.2) as client:
        with pytest.raises(SidecarUnavailable, match="no sidecar answers"):
            await client.load()


async def test_a_timeout_gives_a_fresh_socket(detector: DetectorClient) -> None:
    with pytest.raises(SidecarUnavailable, match="no answer to detect"):
        await detector.detect(PNG, "hang", timeout_s=0.3)
    assert await detector.detect(PNG, "x")


async def test_calls_do_not_wait_for_each_other(detector: DetectorClient) -> None:
    hanging = asyncio.create_task(detector.detect(PNG, "hang", timeout_s=60.0))
    assert await detector.detect(PNG, "x")
    hanging.cancel()
    assert (await detector.ping(timeout_s=60.0))["state"] == "resident"


# -- errors and shapes
@pytest.mark.parametrize("kind", [Evicted, NotResident, Loading, OutOfMemory])
async def test_errors_are_typed_and_never_an_empty_answer(
    detector: DetectorClient, kind: type[Exception]
) -> None:
    with pytest.raises(kind) as refused:
        await detector.detect(PNG, kind.code)  # type: ignore[attr-defined]  # VramError's
    assert refused.value.details == {"n": 1}  # type: ignore[attr-defined]


async def test_a_failure_without_a_code_is_a_model_error(detector: DetectorClient) -> None:
    with pytest.raises(ModelError, match="older server"):
        await detector.detect(PNG, "old")
    with pytest.raises(ModelError, match="wrong shape"):
        await detector.detect(PNG, "wrong")


async def test_the_token_travels_with_the_call(endpoint: str, start_sidecar: Start) -> None:
    start_sidecar()
    async with SceneVlmClient(endpoint, connect_timeout_s=60.0) as client:
        assert await client.query(PNG, "held?", token=(3, 7)) == "held? [3, 7]"
        loaded = await client.load(timeout_s=60.0)
        assert (loaded["lease_id"], loaded["token"]) == ("L1-1", [1, 2])


async def test_pictures_and_a_video_travel_in_one_query(
    monkeypatch: pytest.MonkeyPatch, endpoint: str
) -> None:
    asked: list[QueryOp] = []

    async def call(self: SidecarClient, op: str, fields: JsonMap, **_: object) -> JsonMap:
        asked.append(QueryOp.model_validate({"op": op, **fields}))
        return {"ok": True, "answer": "yes"}

    monkeypatch.setattr(SidecarClient, "call", call)
    client = SceneVlmClient(endpoint)
    assert await client.query(PNG, "held?") == "yes"
    assert await client.query(images=[PNG, PNG], question="moved?") == "yes"
    assert await client.query(PNG, "fell?", video=[PNG, PNG], fps=4.0) == "yes"
    assert [(one.image is not None, len(one.images), len(one.video), one.fps) for one in asked] == [
        (True, 0, 0, None),
        (False, 2, 0, None),
        (True, 0, 2, 4.0),
    ]


@pytest.mark.heavy
async def test_arrays_there_and_back(endpoint: str, start_sidecar: Start) -> None:
    import numpy

    start_sidecar()
    async with PolicyClient(endpoint, connect_timeout_s=60.0) as client:
        assert (await client.reset({"seed": 3}))["seed"] == 3
        state = numpy.arange(6, dtype=numpy.float32).reshape(2, 3)
        actions = await client.get_action({"state": state, "task": "grab"}, token=(1, 2))
        assert actions["action"].dtype == numpy.float32
        assert (actions["action"] == state).all()
