"""Clients of sidecars against a real server process: lazy start, typed errors, death, and ending
only one's own child."""

import asyncio
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import AsyncIterator, Callable, Iterator
from pathlib import Path

import pytest

from tests.support.paths import SUPPORT
from vram_arbiter.clients.sidecar import base
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import Detection, DetectorClient, SceneVlmClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.clients.sidecar.spawn import SpawnSpec
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

SERVER = SUPPORT / "server_process.py"
PNG = b"\x89PNG\r\n\x1a\n"


@pytest.fixture
def endpoint() -> Iterator[str]:
    with tempfile.TemporaryDirectory(prefix="sc") as folder:  # short: a socket path holds 107 bytes
        yield f"ipc://{folder}/s.sock"


def server_command(endpoint: str, mode: str = "") -> list[str]:
    return [sys.executable, str(SERVER), endpoint, mode]


@pytest.fixture
def foreign(endpoint: str) -> Iterator[Callable[[], subprocess.Popen[bytes]]]:
    """Start a sidecar as somebody else would."""
    started: list[subprocess.Popen[bytes]] = []

    def start() -> subprocess.Popen[bytes]:
        started.append(subprocess.Popen(server_command(endpoint)))
        return started[-1]

    yield start
    for process in started:
        process.kill()
        process.wait()


@pytest.fixture
async def detector(endpoint: str) -> AsyncIterator[DetectorClient]:
    async with DetectorClient(
        endpoint, spawn=SpawnSpec(server_command(endpoint)), timeout_s=60.0
    ) as client:
        yield client


def alive(pid: int) -> bool:
    try:
        os.kill(pid, 0)
    except ProcessLookupError:
        return False
    return True


# -- life of a child
async def test_the_first_call_starts_the_sidecar_and_close_ends_it(endpoint: str) -> None:
    client = DetectorClient(endpoint, spawn=SpawnSpec(server_command(endpoint)))
    assert client.child is None
    found = await client.detect(PNG, "red cube")
    assert found == [Detection("b", 0.9, (1, 1, 3, 3)), Detection("a", 0.2, (0, 0, 2, 4))]
    assert found[1].centre == (1.0, 2.0)
    child = client.child
    assert child is not None
    assert client.identity is not None
    assert client.identity["pid"] == child.pid
    await client.close()
    assert not alive(child.pid)
    await client.close()


async def test_an_adopted_sidecar_is_used_and_left_running(
    endpoint: str, foreign: Callable[[], subprocess.Popen[bytes]]
) -> None:
    process = foreign()
    async with SidecarClient(
        endpoint, connect_timeout_s=60.0
    ) as waiting:  # without a spawn spec it waits for the start
        await waiting.call("load")
    async with DetectorClient(endpoint, spawn=SpawnSpec(server_command(endpoint))) as client:
        await client.detect(PNG, "x")
        assert client.child is None
    assert process.poll() is None


async def test_a_dead_child_is_reported_at_once_and_replaced_by_the_next_call(
    detector: DetectorClient,
) -> None:
    await detector.detect(PNG, "x")
    first = detector.child
    assert first is not None
    with pytest.raises(SidecarUnavailable, match="hung up"):
        await detector.detect(PNG, "die")
    await detector.detect(PNG, "x")
    assert detector.child is not None
    assert detector.child.pid != first.pid


async def test_a_killed_child_is_replaced(detector: DetectorClient) -> None:
    await detector.detect(PNG, "x")
    assert detector.child is not None
    os.kill(detector.child.pid, signal.SIGKILL)
    await detector.child.exited.wait()
    assert await detector.detect(PNG, "x")


class DyingInBetween(DetectorClient):
    """Its child dies after the client found that nothing serves the endpoint."""

    def _somebody_listens(self) -> bool:
        return False

    async def _boot(self, spec: SpawnSpec) -> None:
        if self.child is not None:
            os.kill(self.child.pid, signal.SIGKILL)
            await self.child.exited.wait()
        await super()._boot(spec)


async def test_a_replaced_child_leaves_no_log(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The log of a child that died between two looks at it stayed in the temporary folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    async with DyingInBetween(endpoint, spawn=SpawnSpec(server_command(endpoint))) as client:
        await client.detect(PNG, "x")
        first = client.child
        client._drop("a broken connection")
        await client.detect(PNG, "x")
        assert client.child is not first
        assert len(list(tmp_path.glob("sidecar-*.log"))) == 1
    assert list(tmp_path.glob("sidecar-*.log")) == []


async def test_a_child_that_takes_its_time_to_die_is_replaced_all_the_same(
    detector: DetectorClient,
) -> None:
    """Regression: it was waited for as for one that boots, and its old end was the next call's
    error."""
    await detector.detect(PNG, "x")
    first = detector.child
    assert first is not None
    with pytest.raises(SidecarUnavailable, match="hung up"):
        await detector.detect(PNG, "die slowly")
    assert await detector.detect(PNG, "x")
    assert detector.child is not None
    assert detector.child.pid != first.pid


async def test_a_boot_that_fails_says_why(endpoint: str) -> None:
    client = DetectorClient(endpoint, spawn=SpawnSpec(server_command(endpoint, "crash")))
    with pytest.raises(SidecarUnavailable, match="exit code 3: cannot find the weights") as failed:
        await client.detect(PNG, "x")
    assert failed.value.details["exit_code"] == 3
    assert client.child is None
    await client.close()


async def test_a_boot_that_takes_too_long(endpoint: str, tmp_path: Path) -> None:
    spec = SpawnSpec(
        server_command(endpoint, "silent"), boot_timeout_s=0.5, log=tmp_path / "logs" / "s.log"
    )
    async with DetectorClient(endpoint, spawn=spec) as client:
        with pytest.raises(SidecarUnavailable, match=r"within 0\.5 s"):
            await client.detect(PNG, "x")
        child = client.child
        assert child is not None
        assert child.alive
    assert not alive(child.pid)  # close ends it, though it never served
    assert (tmp_path / "logs" / "s.log").exists()


async def test_a_command_that_does_not_exist(
    endpoint: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Each attempt left an empty log file in the temporary folder."""
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    async with SidecarClient(endpoint, spawn=SpawnSpec(["/nonexistent/sidecar"])) as client:
        with pytest.raises(SidecarUnavailable, match="cannot start"):
            await client.load()
    assert list(tmp_path.glob("sidecar-*.log")) == []


async def test_two_clients_starting_one_sidecar_end_up_with_one(endpoint: str) -> None:
    spec = SpawnSpec(server_command(endpoint))
    async with (
        DetectorClient(endpoint, spawn=spec) as one,
        DetectorClient(endpoint, spawn=spec) as two,
    ):
        await asyncio.gather(one.detect(PNG, "x"), two.detect(PNG, "x"))
        assert one.identity is not None
        assert two.identity is not None
        assert one.identity["pid"] == two.identity["pid"]
        assert [one.child is None, two.child is None].count(True) == 1


async def test_a_sidecar_that_owns_the_endpoint_and_is_slow_is_waited_for(
    endpoint: str, foreign: Callable[[], subprocess.Popen[bytes]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Regression: our own child found the endpoint taken and ended, and that was the error, unless
    its owner answered within a second."""
    monkeypatch.setattr(base, "PROBE_S", 0.05)
    owner = foreign()
    async with SidecarClient(endpoint, connect_timeout_s=60.0) as waiting:
        await waiting.load()
    owner.send_signal(signal.SIGSTOP)
    try:
        spec = SpawnSpec(server_command(endpoint))
        async with DetectorClient(endpoint, spawn=spec, connect_timeout_s=60.0) as client:
            found = asyncio.create_task(client.detect(PNG, "x"))
            async with asyncio.timeout(60.0):
                while (child := client.child) is None:
                    await asyncio.sleep(0.01)
                await child.exited.wait()
            with pytest.raises(TimeoutError):
                await asyncio.wait_for(asyncio.shield(found), 20 * base.PROBE_S)
            owner.send_signal(signal.SIGCONT)
            assert await found
            assert client.child is None
    finally:
        owner.send_signal(signal.SIGCONT)


async def test_nobody_there_and_nothing_to_start(endpoint: str) -> None:
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


async def test_the_token_travels_with_the_call(endpoint: str) -> None:
    async with SceneVlmClient(endpoint, spawn=SpawnSpec(server_command(endpoint))) as client:
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
async def test_arrays_there_and_back(endpoint: str) -> None:
    import numpy

    async with PolicyClient(endpoint, spawn=SpawnSpec(server_command(endpoint))) as client:
        assert (await client.reset({"seed": 3}))["seed"] == 3
        state = numpy.arange(6, dtype=numpy.float32).reshape(2, 3)
        actions = await client.get_action({"state": state, "task": "grab"}, token=(1, 2))
        assert actions["action"].dtype == numpy.float32
        assert (actions["action"] == state).all()
