"""A worker: plays the seeds of one cell that its parent names, in a process of its own.

The parent is `runner.benchmark.processes`: a seed a line in, an outcome or an error a line out, as
JSON on one socket, until the parent says no more. A worker whose parent dies ends at once.
"""

from __future__ import annotations

import argparse
import asyncio
import contextlib
import os
import signal
import socket
from collections.abc import AsyncIterator, Callable, Coroutine
from dataclasses import asdict, replace
from json import dumps
from typing import Any

from vram_arbiter.runner.benchmark.entries import entries_of, player_of
from vram_arbiter.runner.cli.common import (
    connect_arbiter,
    lease_rendering,
    start_sidecars,
    warm_up,
)
from vram_arbiter.runner.cli.recording import conclude_recording, record_sim
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonObject

Play = Callable[[int], Coroutine[Any, Any, JsonObject]]
"""Plays a seed and returns its outcome as it is committed. Raises what the recording lost."""


async def open_sidecars(args: argparse.Namespace, stack: contextlib.AsyncExitStack) -> None:
    """Start the sidecars of this machine that its workers share, until the stack ends.

    Raises: ArbiterUnreachable before one starts, and what `start_sidecars` raises.
    """
    if args.skill and not args.no_arbiter:
        async with contextlib.AsyncExitStack() as asking:
            await connect_arbiter(args.arbiter, asking)
    await start_sidecars(args, stack)


@contextlib.asynccontextmanager
async def working(args: argparse.Namespace, cell: int) -> AsyncIterator[Play]:
    """Open the player of the cell of this number. Raises where it cannot be played at all."""
    async with contextlib.AsyncExitStack() as stack:
        arbiter = None
        if args.skill and not args.no_arbiter:
            arbiter = await connect_arbiter(args.arbiter, stack)
            await lease_rendering(arbiter, stack)
        await asyncio.to_thread(warm_up)
        player = player_of(entries_of(args, arbiter)[cell], args)
        dataset = await record_sim(
            args, player.runner, player.runner.rate_hz, lambda: None, stack,
            robot="so101-mobile", strict=True,
        )  # fmt: skip

        async def play(seed: int) -> JsonObject:
            played = await player.play(seed)
            if dataset is not None and dataset.counts.error is not None:
                raise dataset.counts.error  # it was played for the recording
            return asdict(replace(played, node=socket.gethostname()))

        async with player:
            yield play
    await conclude_recording(dataset)


async def serve(args: argparse.Namespace) -> int:
    """Play for the parent; the exit code is 0, or 1 after an error."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # a terminal's goes to the parent, too
    cell, descriptor = args.worker
    reader, writer = await asyncio.open_unix_connection(sock=socket.socket(fileno=descriptor))
    try:
        async with working(args, cell) as play:
            order = asyncio.create_task(reader.readline())
            while seed := await order:
                order = asyncio.create_task(reader.readline())
                playing = asyncio.create_task(play(int(seed)))
                await asyncio.wait([order, playing], return_when=asyncio.FIRST_COMPLETED)
                if not playing.done():
                    os._exit(1)  # its parent died
                writer.write(dumps(await playing).encode() + b"\n")
        return 0
    except VramError as error:
        writer.write(dumps({"raised": error.to_wire()}).encode() + b"\n")
        return 1
    finally:
        with contextlib.suppress(ConnectionError):  # its parent died
            writer.close()
            await writer.wait_closed()
