"""The model's thread stands back behind other programs; the loop that answers `ping` and `revoke`
does not."""

import asyncio
import os

from vram_arbiter.sidecars.worker import Worker


def test_only_the_models_thread_stands_back() -> None:
    async def nice_of_the_worker() -> int:
        worker = Worker(nice=7)
        try:
            return await worker.run(lambda: os.getpriority(os.PRIO_PROCESS, 0))
        finally:
            worker.close()

    ours = os.getpriority(os.PRIO_PROCESS, 0)
    assert asyncio.run(nice_of_the_worker()) == max(7, ours)
    assert os.getpriority(os.PRIO_PROCESS, 0) == ours
