"""The journal is damaged while the daemon is down: nothing may be granted beside a holder that it
no longer names.

Regression: SQLite drops a write-ahead log from its first bad frame on without a word. In each of
these cases the next start granted another client's lease beside a living exclusive holder in use.
"""

import contextlib
import shutil
import signal
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ArbiterProcess
from tests.support.running import Running, running
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

pytestmark = pytest.mark.e2e
PAGE = 4096
FRAME = 24 + PAGE

HOLDER = """
import asyncio, sys
from pathlib import Path
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec
from vram_arbiter.sidecars.device.fake import FakeMemory

async def main():
    memory, size = FakeMemory(Path(sys.argv[1]), "holder", 0), 2 << 30
    footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=0)
    spec = LeaseSpec(
        consumer="holder", model_id="m", mode="exclusive", footprint=footprint, min_residency_s=0.0
    )
    async with AsyncClient(name="holder") as client:
        lease = await client.acquire(spec)
        blocks = [memory.allocate("m", size)]
        await lease.ready(size)
        async with lease.use("grab"):
            print("in use", flush=True)
            await asyncio.to_thread(sys.stdin.readline)
            print("ends", lease.state, flush=True)
        memory.free(blocks.pop())
        memory.empty_cache()
        await lease.release()

asyncio.run(main())
"""


@contextlib.contextmanager
def holder_in_use(arbiter: ArbiterProcess) -> Iterator[Running]:
    """A process by the product's own client: an exclusive lease, bytes on the GPU, a use
    under way."""
    with running("script", [HOLDER, str(arbiter.gpu_folder)], arbiter.environ) as holder:
        assert holder.line() == "in use"
        yield holder


def wal(database: Path) -> Path:
    found = database.with_name(database.name + "-wal")
    assert found.stat().st_size > 3 * FRAME, "the grant lies in the write-ahead log"
    return found


DAMAGES: dict[str, Callable[[Path], Any]] = {
    "log deleted": lambda database: wal(database).unlink(),
    "state folder deleted": lambda database: shutil.rmtree(database.parent),
}
"""Every other damage is one to the journal alone: `host/test_journal_damage`."""


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_journal_grants_nothing_beside_a_holder_in_use(damage: str) -> None:
    arbiter = ArbiterProcess(config="record:\n  enabled: false\n", prepared=True)
    with contextlib.closing(arbiter):
        arbiter.start()
        database = arbiter.state / "journal.sqlite"
        with holder_in_use(arbiter) as holder:
            # it cannot tell the next daemon what the journal does not
            holder.process.send_signal(signal.SIGSTOP)
            arbiter.kill()
            DAMAGES[damage](database)
            arbiter.start()
            with WireClient(arbiter.endpoint) as client:
                waiting = client.hello().acquire("other", GIB)
                status = client.ask("status")
                assert (waiting["state"], status["phase"]) == ("queued", "recovering"), waiting
                assert any("journal" in problem for problem in status["problems"])
                assert any(
                    e["kind"].startswith("journal_") for e in client.ask("history")["events"]
                )
                assert client.ask("subscribe")["ok"]
                holder.process.send_signal(signal.SIGCONT)
                client.push(
                    "event", PATIENCE_S, where=lambda push: push["event"]["kind"] == "reattached"
                )
                (lease,) = (
                    one for one in client.ask("status")["leases"] if one["consumer"] == "holder"
                )
                assert (lease["state"], lease["uses"]) == ("held", 1)
                assert not [push for push in client.pushes if push["push"] == "granted"]
                holder.tell("end\n")
                told = holder.line()
                assert told.startswith(("ends held", "ends revoking")), "it kept its lease"
                granted = client.push("granted", PATIENCE_S)["lease"]
                assert granted["lease_id"] == waiting["lease"]["lease_id"]
