"""`kill -9` of a waiter, of the daemon and of both sides in the middle of a switch: real processes,
sockets and files. `test_steps` kills each side at each step.

Every test ends with the independent checker over the GPU's own allocation log: no instant with
more bytes than the GPU has.
"""

import asyncio
import contextlib
import json
import os
import signal
import sys
import tempfile
from collections.abc import AsyncIterator, Awaitable, Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.fakegpu_check import check_log
from vram_arbiter.arbiter.host.gpu.fake import make_gpu
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import ArbiterUnreachable
from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE

pytestmark = pytest.mark.e2e

GIB = 1 << 30
CAPACITY = 8 * GIB
RESIDUE = GIB // 2
LAG_S = 0.4
PATIENCE_S = 60.0
CONSUMER = Path(__file__).with_name("consumer.py")


class Child:
    """A child process that reports JSON lines."""

    def __init__(self, process: asyncio.subprocess.Process) -> None:
        self.process = process
        self.seen: list[dict[str, Any]] = []

    async def until(self, event: str) -> dict[str, Any]:
        """Read until an event is reported. Fails if the child ends first."""
        assert self.process.stdout is not None
        async with asyncio.timeout(PATIENCE_S):
            while line := await self.process.stdout.readline():
                self.seen.append(json.loads(line))
                if self.seen[-1]["event"] == event:
                    return self.seen[-1]
        pytest.fail(
            f"the child ended ({self.process.returncode}) before {event!r}; it said {self.seen}"
        )

    def tell(self, command: str) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write(f"{command}\n".encode())

    async def kill(self) -> None:
        self.process.kill()
        await self.process.wait()


class Box:
    """One runtime folder with a GPU, an arbiter and any number of consumers."""

    def __init__(self, runtime: Path) -> None:
        self.gpu_folder = runtime / "gpu"
        self.runtime = runtime
        self.children: list[Child] = []
        make_gpu(self.gpu_folder, CAPACITY, release_lag_s=LAG_S)

    async def _start(self, *arguments: str, pause: str = "") -> Child:
        environ = os.environ | {RUNTIME_VARIABLE: str(self.runtime), "VRAM_TEST_PAUSE": pause}
        environ.pop("RUNTIME_DIRECTORY", None)
        with (self.runtime / "errors.log").open("ab") as errors:
            process = await asyncio.create_subprocess_exec(
                sys.executable,
                *arguments,
                stdin=asyncio.subprocess.PIPE,
                stdout=asyncio.subprocess.PIPE,
                stderr=errors,
                env=environ,
            )
        child = Child(process)
        self.children.append(child)
        return child

    async def arbiter(self) -> Child:
        return await self._start(
            "-m",
            "vram_arbiter.arbiter",
            "--gpu",
            f"fake:{self.gpu_folder}",
            "--state-dir",
            str(self.runtime / "state"),
        )

    async def consumer(self, name: str, gib: float, pause: str = "") -> Child:
        return await self._start(
            str(CONSUMER),
            name,
            str(int(gib * GIB)),
            str(self.gpu_folder),
            str(RESIDUE),
            pause=pause,
        )

    @contextlib.asynccontextmanager
    async def client(self) -> AsyncIterator[AsyncClient]:
        async with AsyncClient(
            "test",
            endpoint=f"ipc://{self.runtime}/arbiter.sock",
            role="operator",
            connect_timeout_s=PATIENCE_S,
        ) as client:
            yield client

    async def status(self, good: Callable[[dict[str, Any]], bool]) -> dict[str, Any]:
        """The arbiter's status once it is as wanted."""
        async with asyncio.timeout(PATIENCE_S), self.client() as client:
            while True:
                with contextlib.suppress(ArbiterUnreachable):
                    status: dict[str, Any] = to_map(await client.status())
                    if good(status):
                        return status
                await asyncio.sleep(0.02)

    async def history(self) -> list[dict[str, Any]]:
        async with self.client() as client:
            return [dict(event) for event in (await client.history()).events]

    def log(self) -> str:
        return (self.gpu_folder / "log.jsonl").read_text()

    def check(self) -> None:
        report = check_log(self.log())
        assert not report.problems
        assert report.oom_events == 0
        assert report.peak_bytes <= CAPACITY

    async def close(self) -> None:
        for child in self.children:
            if child.process.returncode is None:
                child.process.kill()
            await child.process.wait()


def in_box(test: Callable[[Box], Awaitable[None]]) -> None:
    async def run() -> None:
        with tempfile.TemporaryDirectory(
            prefix="va"
        ) as folder:  # short: ipc paths have at most 107 characters
            box = Box(Path(folder))
            try:
                await test(box)
                box.check()
            except BaseException:
                print((box.runtime / "errors.log").read_text())
                raise
            finally:
                await box.close()

    asyncio.run(run())


def consumers(status: dict[str, Any]) -> dict[str, str]:
    return {lease["consumer"]: lease["state"] for lease in status["leases"]}


def bytes_of(log: str, name: str, before_first_alloc_of: str) -> int:
    """Bytes that `name` had on the GPU when the other one put its first bytes there."""
    held = 0
    for line in map(json.loads, log.splitlines()):
        if line["name"] == before_first_alloc_of and line["op"] == "alloc":
            return held
        if line["name"] == name:
            held = line["process_bytes"]
    pytest.fail(f"{before_first_alloc_of} never allocated")


def test_a_killed_waiter_leaves_the_queue_and_its_place_to_the_next() -> None:
    async def test(box: Box) -> None:
        await box.arbiter()
        holder = await box.consumer("holder", 5)
        await holder.until("ready")
        holder.tell("use")
        await holder.until("in_use")
        doomed = await box.consumer("doomed", 6)
        await box.status(lambda status: consumers(status).get("doomed") == "queued")
        waiter = await box.consumer("waiter", 4)
        await box.status(lambda status: consumers(status).get("waiter") == "queued")
        await doomed.kill()
        await box.status(lambda status: "doomed" not in consumers(status))
        holder.tell("end")
        await waiter.until("ready")
        assert bytes_of(box.log(), "holder", "waiter") == RESIDUE

    in_box(test)


def test_the_daemon_killed_in_the_middle_of_a_switch() -> None:
    async def test(box: Box) -> None:
        daemon = await box.arbiter()
        holder = await box.consumer("holder", 5)
        granted = await holder.until("granted")
        await holder.until("ready")
        holder.tell("use")
        await holder.until("in_use")
        waiter = await box.consumer("waiter", 5)
        await box.status(lambda status: consumers(status).get("holder") == "revoking")
        await daemon.kill()
        await box.arbiter()
        status = await box.status(
            lambda status: (
                set(consumers(status)) == {"holder", "waiter"} and status["phase"] == "serving"
            )
        )
        (lease,) = (lease for lease in status["leases"] if lease["consumer"] == "holder")
        assert lease["lease_id"] == granted["lease_id"]
        assert lease["token"] == granted["token"], "a lease that survives keeps its token"
        assert lease["uses"] == 1, "and the use that was under way"
        assert status["epoch"] > granted["token"][0]
        holder.tell("end")
        later = await waiter.until("granted")
        assert later["token"] > granted["token"]
        await waiter.until("ready")
        assert bytes_of(box.log(), "holder", "waiter") == RESIDUE

    in_box(test)


def test_daemon_and_holder_killed_together() -> None:
    async def test(box: Box) -> None:
        daemon = await box.arbiter()
        holder = await box.consumer("holder", 5)
        await holder.until("ready")
        waiter = await box.consumer("waiter", 5, pause="unloading")
        await holder.until("unloading")
        os.kill(daemon.process.pid, signal.SIGKILL)
        await holder.kill()
        await daemon.process.wait()
        await box.arbiter()
        await waiter.until("ready")
        assert bytes_of(box.log(), "holder", "waiter") == 0

    in_box(test)


def test_a_holder_in_use_is_asked_but_left_alone_until_its_safe_point() -> None:
    async def test(box: Box) -> None:
        await box.arbiter()
        holder = await box.consumer("holder", 5)
        await holder.until("ready")
        holder.tell("use")
        await holder.until("in_use")
        waiter = await box.consumer("waiter", 5)
        status = await box.status(lambda status: consumers(status).get("holder") == "revoking")
        assert consumers(status)["waiter"] == "queued"
        async with box.client() as client:
            why = await client.why("waiter")
        assert why.leases[0].blockers[0].consumer == "holder"
        holder.tell("end")
        await waiter.until("ready")
        kinds = [
            event["kind"]
            for event in await box.history()
            if event["kind"] in ("use_ended", "unloading", "verified", "granted")
        ]
        assert kinds == ["granted", "use_ended", "unloading", "verified", "granted"]

    in_box(test)
