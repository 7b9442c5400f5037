"""A worker: plays the seeds of one cell that its parent names, in a process of its own.

The parent is `runner.benchmark.processes`: a seed a line in, an outcome or an error a line out, as
JSON on one socket. A parent that has ended, or says no more, ends the episode in progress.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import signal
import socket
from collections.abc import AsyncIterator
from dataclasses import asdict, replace
from json import dumps
from typing import TYPE_CHECKING

from vram_arbiter.runner.benchmark.entries import entries_of, player_of
from vram_arbiter.runner.cli.common import connect_arbiter, lease_rendering, warm_up
from vram_arbiter.runner.cli.recording import conclude_recording, record_sim
from vram_arbiter.schemas.errors import Cancelled, VramError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

if TYPE_CHECKING:
    from vram_arbiter.runner.benchmark.player import Player


@contextlib.asynccontextmanager
async def working(args: argparse.Namespace, cell: int) -> AsyncIterator[Player]:
    """Open the player of the cell of this number. Raises the first error of its recording."""
    async with contextlib.AsyncExitStack() as stack:
        arbiter = None
        if args.skill and not args.no_arbiter:
            arbiter = await connect_arbiter(args.arbiter, stack)
            await lease_rendering(arbiter, stack)
        await asyncio.to_thread(warm_up)
        player = player_of(entries_of(args, arbiter)[cell], args)
        dataset = await record_sim(
            args, player.runner, player.runner.rate_hz, player.stop, stack,
            robot="so101-mobile", strict=True,
        )  # fmt: skip
        async with player:
            yield player
    if dataset is not None and dataset.counts.error is not None:
        raise dataset.counts.error  # it was played for the recording
    await conclude_recording(dataset)


async def play(player: Player, seed: int) -> JsonObject:
    """Return a seed's outcome as it is committed. Raises Cancelled."""
    return asdict(replace(await player.play(seed), node=socket.gethostname()))


async def serve(args: argparse.Namespace) -> int:
    """Play for the parent; the exit code is 0, or 1 after an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's goes to the parent, too
    cell, descriptor = args.worker
    reader, writer = await asyncio.open_unix_connection(sock=socket.socket(fileno=descriptor))

    def say(answer: JsonMap) -> None:
        writer.write(dumps(answer).encode() + b"\n")

    try:
        async with working(args, cell) as player:
            seeds = asyncio.Queue[int | None]()
            listening = asyncio.create_task(_listen(reader, player, seeds))
            with contextlib.suppress(Cancelled):
                while (seed := await seeds.get()) is not None:
                    say(await play(player, seed))
            listening.cancel()
        return 0
    except VramError as error:
        say({"raised": error.to_wire()})
        return 1
    finally:
        with contextlib.suppress(ConnectionError):  # the parent has ended
            writer.close()
            await writer.wait_closed()


async def _listen(
    reader: asyncio.StreamReader, player: Player, seeds: asyncio.Queue[int | None]
) -> None:
    while line := await reader.readline():
        seeds.put_nowait(int(line))
    player.stop()
    seeds.put_nowait(None)
