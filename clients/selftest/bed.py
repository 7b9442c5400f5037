"""Place of a self-test: one GPU, a private daemon on it, and children that hold bytes.

Children die with this process; no other process is signaled. Must not know what is measured.
"""

import asyncio
import json
import os
import sys
import time
from collections.abc import AsyncIterator, Collection
from contextlib import asynccontextmanager
from dataclasses import dataclass, field
from typing import Any, Final

from vram_arbiter.clients.calibration.gpu import Gpu, Reading
from vram_arbiter.clients.cli.programs import Child, Programs
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.sidecar.build import CLIENTS
from vram_arbiter.schemas.defaults import RESERVE_BYTES, VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import SidecarUnavailable
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.threads import answered_within
from vram_arbiter.schemas.sizes import format_bytes

READING_S: Final = 5.0
"""Above the daemon's own limit of a reading (2 s): a GPU that takes longer hangs."""
POLL_S: Final = 0.002
MODEL_S: Final = 90.0
"""Imports of three sidecars at once, on two busy cores."""
HOLDER: Final = "sidecars.holder"
RUN: Final = ("clients", "run", "--min-residency", "0", "--on-revoke", "term")


class Skipped(Exception):
    """A row cannot run here; the text says why."""


class Missed(Exception):
    """A row found something else than the product claims; the text says what."""


async def ask(holder: Child, word: str, *sizes: int) -> JsonMap:
    """Return the answer of a holder to a request of `sidecars.holder`. Raises SidecarUnavailable
    where it has failed."""
    asked, answers = holder.process.stdin, holder.process.stdout
    assert asked is not None
    assert answers is not None
    asked.write(f"{' '.join([word, *map(str, sizes)])}\n".encode())
    line = await answers.readline()
    answer: JsonMap = json.loads(line) if line else {"error": f"it ended: {holder.tail()}"}
    if "error" in answer:
        raise SidecarUnavailable(answer["error"])
    return answer


@dataclass(slots=True)
class Bed:
    """Where rows are measured. `memory_bytes` is the most that is on the GPU at a time."""

    gpu: Gpu
    found: Reading  # before all others
    memory_bytes: int
    programs: Programs
    client: AsyncClient
    skills: Collection[str]  # whose sidecars are needed
    patience_s: float = VERIFY_TIMEOUT_S  # of memory that is on its way back
    copies: JsonMap = field(default_factory=dict)

    @property
    def simulated(self) -> bool:
        return self.gpu.device.startswith("fake:")

    @property
    def part_bytes(self) -> int:
        """Bytes of a holder beside its context."""
        return self.memory_bytes // 4

    @property
    def lease_bytes(self) -> int:
        """All that can be leased, less what the driver may take meanwhile: two leases of so many
        never fit."""
        left = self.gpu.total_bytes - self.found.used_bytes
        return left - RESERVE_BYTES - 2 * VERIFY_TOLERANCE_BYTES

    async def read(self) -> Reading:
        """Raises ProbeFailed."""
        return await answered_within(READING_S, self.gpu.read)

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

    @asynccontextmanager
    async def holder(
        self, lease: str = "", size_bytes: int | None = None, **environ: str
    ) -> AsyncIterator[Child]:
        """Start a process that holds a context and so many bytes (None: neither), and end it again:
        under a lease of that name (`vramctl run`), or without one, which makes it a stowaway. Its
        bytes are back at the end of the block.

        Raises NotInstalled, Missed, and SidecarUnavailable with the process's error.
        """
        if not self.simulated:
            need("the row", "torch", extra="sidecars")
        used_bytes, command = await self.used(), [HOLDER, self.gpu.device]
        if lease:
            need_of = ("--vram", f"{self.lease_bytes}B", "--gpu", self.gpu.uuid, "--name", lease)
            program = (sys.executable, "-m", f"vram_arbiter.{HOLDER}", self.gpu.device)
            command = [*RUN, *need_of, "--", *program]
        name = lease or "stowaway"
        made = await self.programs.start(name, *command, asked=True, **environ)
        try:
            if size_bytes is not None:
                await ask(made, "fill", size_bytes)
            yield made
        finally:
            await self.programs.stop(name)
        await self.returned(used_bytes)

    @asynccontextmanager
    async def model(self, skill: str) -> AsyncIterator[tuple[Any, RSkillManifest]]:
        """Make the model of a shipped skill resident, and unload it again. Gives the client of its
        kind. All sidecars start at first use. Its bytes are back at the end of the block.

        Raises NotInstalled, Missed, SidecarUnavailable, and the sidecar's errors.
        """
        need("the row", "torch", "transformers", "lerobot", extra="sidecars")
        manifest = load_manifest(configs_folder(os.environ) / "rskills" / skill / "rskill.yaml")
        for name in sorted(set(self.skills) - set(self.programs.running)):
            await self.programs.start(
                name, "sidecars", "--name", name, "--rskill", name, "--device", self.gpu.device,
                "--gpu", self.gpu.uuid, "--footprint", str(self.memory_bytes),
                "--min-residency-s", "0",
            )  # fmt: skip
        async with CLIENTS[manifest.kind](f"ipc://{self.programs.log_dir}/{skill}.sock") as client:
            try:
                await client.ping(timeout_s=MODEL_S)
            except SidecarUnavailable:
                self.programs.check()  # says why it ended
                raise
            used_bytes = await self.used()
            await client.load()
            try:
                yield client, manifest
            finally:
                await client.unload()
            await self.returned(used_bytes)
