"""Place of a self-test: one GPU, a private daemon on it, and children that hold bytes.

Children die with this process; no other process is signaled. Must not know what is measured.
"""

import asyncio
import json
import os
import sys
import threading
import time
from asyncio.subprocess import PIPE, Process
from collections.abc import AsyncIterator, Callable, Collection, Mapping
from concurrent.futures import Future
from contextlib import asynccontextmanager, suppress
from dataclasses import dataclass, field
from importlib.util import find_spec
from pathlib import Path
from signal import SIGKILL
from typing import Any, Final

from vram_arbiter.clients.calibration.gpu import Gpu, Reading
from vram_arbiter.clients.cli.demo_programs import Programs
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.foreign.program import dying_with_parent, send_below
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.build import CLIENTS
from vram_arbiter.schemas.defaults import VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import ProbeFailed, SidecarUnavailable, from_wire
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.sizes import format_bytes

READING_S: Final = 5.0
"""Above the daemon's own limit of a reading (2 s): a GPU that takes longer hangs."""
POLL_S: Final = 0.002
END_S: Final = 10.0
MODEL_S: Final = 90.0
"""Imports of three sidecars at once, on two busy cores."""
HOLDER: Final = (sys.executable, "-m", "vram_arbiter.sidecars.holder")
RUN: Final = (sys.executable, "-m", "vram_arbiter.clients", "run", "--min-residency", "0")


class Skipped(Exception):
    """A row cannot run here; the text says why."""


class Missed(Exception):
    """A row found something else than the product claims; the text says what."""


def need(*packages: str, extra: str) -> None:
    """Raises Skipped where one of the packages is not installed."""
    if not all(map(find_spec, packages)):
        raise Skipped(f"install 'vram-arbiter[{extra}]'")


async def in_thread[T](work: Callable[[], T], limit_s: float) -> T:
    """Do work that may hang. A thread that hangs is left behind, and keeps no program from ending.

    Raises what the work raises, and ProbeFailed after `limit_s`.
    """
    done: Future[T] = Future()
    done.set_running_or_notify_cancel()

    def run() -> None:
        try:
            done.set_result(work())
        except BaseException as error:  # noqa: BLE001  raised where it is awaited
            done.set_exception(error)

    threading.Thread(target=run, name="selftest", daemon=True).start()
    try:
        async with asyncio.timeout(limit_s):
            return await asyncio.shield(asyncio.wrap_future(done))
    except TimeoutError:
        raise ProbeFailed(
            f"the driver gave no answer within {limit_s:g} s", hint="see nvidia-smi and dmesg"
        ) from None


class Holder:
    """A process of `sidecars.holder`; `process` is it, or the `vramctl run` that started it."""

    pid: int

    def __init__(self, process: Process, log: Path) -> None:
        self.process = process
        self._log = log

    async def begin(self) -> None:
        """Wait until it runs: under a lease, until that is granted."""
        self.pid = (await self._answer())["pid"]

    async def ask(self, word: str, *sizes: int) -> JsonMap:
        """Raises the process's typed error, and SidecarUnavailable where it has ended."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{' '.join([word, *map(str, sizes)])}\n".encode())
        return await self._answer()

    async def _answer(self) -> JsonMap:
        assert self.process.stdout is not None
        line = await self.process.stdout.readline()
        if not line:
            told = self._log.read_text(errors="replace").splitlines()[-1:]
            raise SidecarUnavailable(f"a holder ended: {''.join(told)}")
        answer: JsonMap = json.loads(line)
        if "error" in answer:
            raise from_wire(answer["error"])
        return answer

    async def end(self) -> None:
        """End it in order, and by force after END_S."""
        assert self.process.stdin is not None
        self.process.stdin.close()
        with suppress(TimeoutError):
            await asyncio.wait_for(self.process.wait(), END_S)
        await self.kill()

    async def kill(self) -> None:
        """End it with SIGKILL, if it has not ended; its program dies with it."""
        if self.process.returncode is None:
            send_below(self.process.pid, SIGKILL)
        await self.process.wait()


@dataclass(slots=True)
class Model:
    """A sidecar with its model resident."""

    client: Any  # of the manifest's kind
    manifest: RSkillManifest
    pid: int


@dataclass(slots=True)
class Bed:
    """Where rows are measured. `memory_bytes` is the most that is on the GPU at a time;
    `lease_bytes` are all that the daemon has, so that one lease excludes another."""

    gpu: Gpu
    found: Reading  # before all others
    memory_bytes: int
    lease_bytes: int
    programs: Programs
    client: AsyncClient
    daemon: tuple[str, ...]  # its arguments
    skills: Collection[str]  # whose sidecars are needed
    patience_s: float = VERIFY_TIMEOUT_S  # of memory that is on its way back
    copies: JsonMap = field(default_factory=dict)
    _started: bool = False  # the sidecars

    @property
    def simulated(self) -> bool:
        return self.gpu.device.startswith("fake:")

    @property
    def part_bytes(self) -> int:
        """Bytes of a holder beside its context."""
        return self.memory_bytes // 4

    # -- readings
    async def read(self) -> Reading:
        """Raises ProbeFailed."""
        return await in_thread(self.gpu.read, READING_S)

    async def used(self) -> int:
        """Return the GPU's used bytes. Raises ProbeFailed."""
        return (await self.read()).used_bytes

    async def returned(self, used_bytes: int) -> float:
        """Wait until no more than `used_bytes`, and the tolerance, are used. Return the seconds.
        Raises Missed after `patience_s`."""
        began_s = time.monotonic()
        while (more := await self.used() - used_bytes) > VERIFY_TOLERANCE_BYTES:
            if time.monotonic() - began_s > self.patience_s:
                raise Missed(f"{format_bytes(more)} did not return in {self.patience_s:g} s")
            await asyncio.sleep(POLL_S)
        return time.monotonic() - began_s

    # -- children
    @asynccontextmanager
    async def holder(
        self, lease: str = "", environ: Mapping[str, str] | None = None
    ) -> AsyncIterator[Holder]:
        """Start a process that can hold bytes, and end it again: under a lease of that name
        (`vramctl run`), or without one, which makes it a stowaway. Its bytes are back at the end of
        the block.

        Raises Skipped, Missed, SidecarUnavailable.
        """
        if not self.simulated:
            need("torch", extra="sidecars")
        used_bytes, command = await self.used(), [*HOLDER, self.gpu.device]
        if lease:
            vram = ("--vram", f"{self.lease_bytes}B", "--gpu", self.gpu.uuid)
            command = [*RUN, *vram, "--name", lease, "--on-revoke", "term", "--", *command]
        path = self.programs.log_dir / "holder.log"
        with path.open("wb") as log:
            process = await asyncio.create_subprocess_exec(
                *command, stdin=PIPE, stdout=PIPE, stderr=log, preexec_fn=dying_with_parent(),
                env=dict(os.environ) | dict(self.programs.environ) | dict(environ or {}),
            )  # fmt: skip
        made = Holder(process, path)
        try:
            await made.begin()
            yield made
        finally:
            await made.end()
        await self.returned(used_bytes)

    @asynccontextmanager
    async def model(self, skill: str) -> AsyncIterator[Model]:
        """Make the model of a shipped skill resident, and unload it again. All sidecars start at
        first use. Its bytes are back at the end of the block.

        Raises Skipped, Missed, SidecarUnavailable, and the sidecar's errors.
        """
        need("torch", "transformers", "lerobot", "PIL", extra="sidecars")
        manifest = load_manifest(configs_folder(os.environ) / "rskills" / skill / "rskill.yaml")
        if not self._started:
            self._started = True
            for name in self.skills:
                await self._start(name)
        endpoint = f"ipc://{self.programs.log_dir}/{skill}.sock"
        async with CLIENTS[manifest.kind](endpoint, connect_timeout_s=MODEL_S) as client:
            await self._answers(client)
            used_bytes = await self.used()
            await client.load()
            try:
                yield Model(client, manifest, self.programs.running[skill].process.pid)
            finally:
                await client.unload()
            await self.returned(used_bytes)

    async def _start(self, skill: str) -> None:
        await self.programs.start(
            skill, "sidecars", "--name", skill, "--rskill", skill, "--device", self.gpu.device,
            "--gpu", self.gpu.uuid, "--footprint", str(self.memory_bytes),
            "--min-residency-s", "0", "--parent", str(os.getpid()),
        )  # fmt: skip

    async def _answers(self, client: SidecarClient) -> None:
        try:
            await client.ping(timeout_s=MODEL_S)
        except SidecarUnavailable:
            self.programs.check()  # says why it ended
            raise

    async def restart_daemon(self) -> None:
        """Kill the daemon, and start it again on the same files."""
        process = self.programs.running["arbiter"].process
        send_below(process.pid, SIGKILL)
        await process.wait()
        await self.start_daemon()

    async def start_daemon(self) -> None:
        await self.programs.start("arbiter", "arbiter", *self.daemon)
