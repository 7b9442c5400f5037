"""Two models that do not fit beside each other take turns on one GPU of 8 GB.

Each keeps its lease between jobs, because loading is slow. It leaves only when the other one needs
the room, after the job that runs, and acquires again for its next job.
"""

import anyio

from vram_arbiter import AsyncClient, AsyncLease, LeaseLost, LeaseRevoking

JOBS = 3


class Model:
    """Stands for a model of any framework: a real one loads and frees tensors here."""

    def __init__(self, name: str, vram: str) -> None:
        self.name = name
        self.vram = vram

    async def load(self) -> None:
        print(f"{self.name}: load")

    def unload(self) -> None:  # a plain function runs in a worker thread
        print(f"{self.name}: unload")


async def acquired(arbiter: AsyncClient, model: Model) -> AsyncLease:
    lease = await arbiter.acquire(
        vram=model.vram, model=model.name, unload=model.unload, min_residency_s=0.0
    )
    await model.load()
    return lease


async def work(arbiter: AsyncClient, model: Model) -> None:
    lease = await acquired(arbiter, model)
    done = 0
    while done < JOBS:
        try:
            async with lease.use(f"job {done}"):
                print(f"{model.name}: job {done}")
                await anyio.sleep(0.05)
            done += 1
        except (LeaseRevoking, LeaseLost):  # the other model needs the room
            await lease.wait_gone()
            lease = await acquired(arbiter, model)
    await lease.give_up()


async def main() -> None:
    async with AsyncClient("turns") as arbiter, anyio.create_task_group() as tasks:
        tasks.start_soon(work, arbiter, Model("detector", "5.3GB"))
        tasks.start_soon(work, arbiter, Model("policy", "4.3GB"))


anyio.run(main)
