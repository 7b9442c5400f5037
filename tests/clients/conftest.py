"""What the tests of the clients share: a scripted arbiter, a way to write specs, and waiting for a
condition with a deadline."""

from collections.abc import AsyncIterator, Callable, Iterator
from typing import Any

import anyio
import pytest

from tests.support.beside import Beside, Start
from tests.support.process import ArbiterProcess
from tests.support.protocol_wire import Wire
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

TTL_S = 120.0
"""A daemon that is started again on a busy machine is away for seconds: nobody is to fence himself
meanwhile."""


@pytest.fixture
async def beside() -> AsyncIterator[Start]:
    """`beside(work())` runs a coroutine beside the test; what still runs at its end is canceled."""
    async with anyio.create_task_group() as tasks:
        yield lambda work: Beside(tasks, work)
        tasks.cancel_scope.cancel()


@pytest.fixture
def link() -> Wire:
    """The client's protocol after its greeting, and the arbiter's end."""
    made = Wire()
    made.greet()
    return made


@pytest.fixture
def spec() -> Callable[..., LeaseSpec]:
    """`spec("detector", 5)`: a lease of 5 GiB without residue or minimum residency."""

    def make(consumer: str, gib: float, **fields: object) -> LeaseSpec:
        size = int(gib * GIB)
        footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=0)
        wanted: dict[str, Any] = {"min_residency_s": 0.0, "ttl_s": TTL_S, **fields}
        return LeaseSpec(consumer=consumer, model_id=consumer, footprint=footprint, **wanted)

    return make


@pytest.fixture
def until() -> Callable[..., object]:
    """`await until(lambda: …)`: poll on the loop until it is true; fails after a minute."""

    async def wait(condition: Callable[[], bool]) -> None:
        with anyio.fail_after(PATIENCE_S):
            while not condition():
                await anyio.sleep(0.01)

    return wait


@pytest.fixture
def client(arbiter_daemon: ArbiterProcess) -> Iterator[Client]:
    """A blocking client of `arbiter_daemon`."""
    with Client("t", endpoint=arbiter_daemon.endpoint) as client:
        yield client
