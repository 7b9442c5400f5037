"""Seeds played by worker processes of this machine (`runner.benchmark.worker`).

A worker that dies or is late costs its seed an attempt, and another one takes its place: a policy
that crashes, or takes all memory, ends its episode and not the run.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import socket
import subprocess
import sys
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Final, Self

from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients.ray.mapping import Seeds
from vram_arbiter.runner.benchmark.folder import Tell, keep
from vram_arbiter.runner.benchmark.outcomes import SeedOutcome, unplayed
from vram_arbiter.schemas.errors import from_wire
from vram_arbiter.schemas.plain import JsonObject

LINE_MAX_BYTES: Final = 1 << 20
LEAVE_S: Final = 300.0
"""To the end of a worker that has no more to do: a recording is finished meanwhile."""
STDERR: Final = 2


class Processes:
    """Up to `count` workers, started by `argv` of `vram-runner benchmark`; a call that takes
    `deadline_s` is late.
    """

    def __init__(self, argv: Sequence[str], count: int, deadline_s: float) -> None:
        self._command = [sys.executable, "-m", "vram_arbiter.runner", *argv, "--worker"]
        self._count = count
        self._deadline_s = deadline_s
        self._workers = set[_Worker]()
        self._stopping = False

    def stop(self) -> None:
        """End `play` soon; episodes in progress do not count."""
        self._stopping = True
        for worker in self._workers:
            worker.process.kill()

    async def play(self, cell: int, seeds: Sequence[int], folder: Path, tell: Tell) -> None:
        """Play seeds of the cell of this number, and commit their outcomes to the folder.

        Raises what a worker raises where its cell cannot be played at all.
        """
        self._stopping = False
        todo = Seeds(seeds, ())
        tasks = [
            asyncio.create_task(self._work(cell, todo, folder, tell))
            for _ in range(min(self._count, len(seeds)))
        ]
        try:
            await asyncio.gather(*tasks)
            # only now: a skill takes its model along, which others may still use
            await asyncio.gather(*(worker.end() for worker in self._workers))
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
            await asyncio.gather(*(worker.kill() for worker in self._workers))
            self._workers.clear()

    async def _work(self, cell: int, todo: Seeds, folder: Path, tell: Tell) -> None:
        worker: _Worker | None = None
        while todo and not self._stopping:
            seed = todo.take()
            if worker is None:
                worker = await _Worker.start([*self._command, str(cell)])
                self._workers.add(worker)
            try:
                told = SeedOutcome(**await worker.play(seed, self._deadline_s))
            except _Lost as lost:
                self._workers.discard(worker)
                worker = None
                if self._stopping:
                    return
                todo.lost(seed, str(lost))
                if seed not in todo.failed:
                    continue
                told = unplayed(seed, todo.failed[seed])
            keep(folder, told)
            tell(told)


class _Lost(Exception):
    """A worker died or was late, and is dead now."""


@dataclass(frozen=True, slots=True, eq=False)
class _Worker:
    """One process."""

    process: subprocess.Popen[bytes]
    reader: asyncio.StreamReader
    writer: asyncio.StreamWriter

    @classmethod
    async def start(cls, command: Sequence[str]) -> Self:
        ours, theirs = socket.socketpair()
        with theirs:
            process = _spawn(command, theirs.fileno())
        return cls(process, *await asyncio.open_unix_connection(sock=ours, limit=LINE_MAX_BYTES))

    async def play(self, seed: int, deadline_s: float) -> JsonObject:
        """Return the outcome of a seed. Raises _Lost, and what keeps the cell from being played."""
        self.writer.write(b"%d\n" % seed)
        try:
            async with asyncio.timeout(deadline_s):
                answer = _read(await self.reader.readline())
        except TimeoutError:
            await self.kill()
            raise _Lost(f"no answer within {deadline_s:g} s") from None
        except ConnectionError:
            answer = {}
        if not answer:
            raise _Lost(f"its worker ended with {await self.kill()}")
        return answer

    async def end(self) -> None:
        """Let it end in order. Raises the error of its recording."""
        with contextlib.suppress(OSError, TimeoutError):
            self.writer.write_eof()
            async with asyncio.timeout(LEAVE_S):
                _read(await self.reader.readline())
                await asyncio.to_thread(self.process.wait)

    async def kill(self) -> int:
        """Kill it where it still runs; return its exit code."""
        self.process.kill()
        self.writer.close()
        return await asyncio.to_thread(self.process.wait)


def _spawn(command: Sequence[str], descriptor: int) -> subprocess.Popen[bytes]:
    return subprocess.Popen(
        [*command, str(descriptor)],
        pass_fds=[descriptor],
        stdin=subprocess.DEVNULL,
        stdout=STDERR,  # stdout is the run's result
        env=os.environ | traces.environ(),
    )


def _read(line: bytes) -> JsonObject:
    """Return an answer; nothing for one that was broken off. Raises the worker's error."""
    if not line.endswith(b"\n"):
        return {}
    answer: JsonObject = json.loads(line)
    if "raised" in answer:
        raise from_wire(answer["raised"])
    return answer
