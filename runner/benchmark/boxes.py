"""Seeds played on the boxes of a Ray cluster: each worker is an actor, with the arbiter, the
sidecars and the files of its box. Placement, deadlines and replays are those of `clients.ray`.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import threading
from collections.abc import AsyncIterator, Coroutine, Iterator, Sequence
from concurrent.futures import as_completed, wait
from pathlib import Path
from typing import Any, Final

from vram_arbiter.clients.ray.fleet import Fleet
from vram_arbiter.clients.ray.mapping import SeedsFailed
from vram_arbiter.runner.benchmark.folder import RUN, Tell, keep
from vram_arbiter.runner.benchmark.outcomes import SeedOutcome, unplayed
from vram_arbiter.runner.benchmark.worker import Play, open_sidecars, working
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonObject

CLOSE_S: Final = 30.0
"""To the end of a worker: one in the middle of an episode is not waited for any longer."""


class Boxes:
    """`count` workers on each box of the fleet, which read the flags from `argv`; an episode that
    takes `deadline_s` is late.
    """

    def __init__(self, fleet: Fleet, argv: Sequence[str], count: int, deadline_s: float) -> None:
        self._fleet = fleet
        self._argv, self._count, self._deadline_s = list(argv), count, deadline_s
        self._stopping = threading.Event()

    def stop(self) -> None:
        """End `play` with its next outcome."""
        self._stopping.set()

    async def play(self, cell: int, seeds: Sequence[int], folder: Path, tell: Tell) -> None:
        """As `Processes.play`; without a box that can play the cell its seeds are errors."""
        self._stopping.clear()
        loop = asyncio.get_running_loop()

        def work() -> None:
            for played in self._played(cell, seeds, folder):
                loop.call_soon_threadsafe(tell, played)
                if self._stopping.is_set():
                    return

        await asyncio.to_thread(work)

    def _played(self, cell: int, seeds: Sequence[int], folder: Path) -> Iterator[SeedOutcome]:
        fleet = self._fleet
        workers = fleet.spread(
            Worker, self._argv, cell, os.getcwd(), per_node=self._count, nodes=list(fleet.boxes())
        )
        try:
            able = self._able(workers, seeds)
            for result in fleet.map(able, "play", seeds, out=folder, deadline_s=self._deadline_s):
                yield SeedOutcome(**result.value)
        except SeedsFailed as error:
            for seed, why in error.details["failed"].items():
                keep(folder, lost := unplayed(int(seed), why))
                yield lost
        finally:  # before another cell looks for sidecars
            wait([worker.close.remote().future() for worker in workers], CLOSE_S)

    def _able(self, workers: Sequence[Any], seeds: Sequence[int]) -> list[Any]:
        """Wait for the first worker that can play, as long as for an episode, and leave out those
        that cannot. Raises SeedsFailed for all seeds where none can.
        """
        begun = {worker.__ray_ready__.remote().future(): worker for worker in workers}
        failed, why = set[Any](), "no box"
        try:
            for future in as_completed(begun, self._deadline_s):
                if (error := future.exception()) is None:
                    return [worker for worker in workers if worker not in failed]
                failed.add(begun[future])
                why = str(error).strip().splitlines()[-1]  # behind where it was raised
        except TimeoutError:
            why = f"no box could begin within {self._deadline_s:g} s"
        raise SeedsFailed(why, details={"failed": dict.fromkeys(map(str, seeds), why)})


class Worker:
    """Plays seeds of one cell on a box. `folder` is where the command was started.

    Raises: what keeps the cell from being played here; other boxes go on.
    """

    def __init__(self, argv: Sequence[str], cell: int, folder: str) -> None:
        self._loop = asyncio.new_event_loop()
        threading.Thread(target=self._loop.run_forever, name="worker", daemon=True).start()
        self._opened = _opened(_flags(argv, folder), cell)
        self._play = self._done(self._opened.__aenter__())

    def play(self, seed: int) -> JsonObject:
        return self._done(self._play(seed))

    def close(self) -> None:
        self._done(self._opened.__aexit__(None, None, None))
        self._loop.call_soon_threadsafe(self._loop.stop)

    def _done[T](self, work: Coroutine[Any, Any, T]) -> T:
        return asyncio.run_coroutine_threadsafe(work, self._loop).result()


def _flags(argv: Sequence[str], folder: str) -> argparse.Namespace:
    """Read the flags as the command did. Raises ConfigError on a box without its folders."""
    from vram_arbiter.runner.__main__ import parse

    hint = "start it in a folder that all boxes share, or with --no-videos in one that all have"
    try:
        os.chdir(folder)
    except OSError as error:
        raise ConfigError(f"{folder} is not on this box: {error}", hint=hint) from None
    args = parse(list(argv))
    if args.videos and not (args.out / RUN).is_file():
        raise ConfigError(f"--out {args.out} of this box is another folder", hint=hint)
    return args


@contextlib.asynccontextmanager
async def _opened(args: argparse.Namespace, cell: int) -> AsyncIterator[Play]:
    async with contextlib.AsyncExitStack() as stack:
        await open_sidecars(args, stack)
        yield await stack.enter_async_context(working(args, cell))
