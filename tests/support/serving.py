"""A stand-in server of the wire beside its test."""

import asyncio
from collections.abc import AsyncIterator
from contextlib import asynccontextmanager

from vram_arbiter.clients.net.server import Handler, RouterServer


@asynccontextmanager
async def answering(server: RouterServer, handle: Handler) -> AsyncIterator[RouterServer]:
    """Answer with `handle` until the end of the block."""
    async with server:
        task = asyncio.create_task(server.serve(handle))
        try:
            yield server
        finally:
            task.cancel()
            await asyncio.gather(task, return_exceptions=True)
