"""What an event costs does not grow with those whom it does not concern: counted in instructions,
which no neighbour disturbs."""

import sys
from types import FrameType
from typing import Any

import pytest

from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Reply
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

GPU = GpuId("GPU-0")
FEW, MANY = 5, 500
SIZE = 4096


class Counted:
    """A core with some leases and as many connections that nothing happens to, and the instructions
    that each event took."""

    def __init__(self, leases: int, *, listed: bool) -> None:
        gpu = GpuInfo(GPU, 0, "gpu", d.GIB, 0)
        self.core = Arbiter(Settings(epoch=1, gpus=(gpu,), leases_per_client_max=MANY), 0.0)
        self.listed = listed
        self.now = 1.0
        self.requests = 0
        for number in range(leases):
            self.hello(ClientId(f"idle{number}"), ProcessKey(100, 1), f"i{number}")
        self.tell(self.reading())
        for _ in range(leases):
            self.load(self.acquire(ClientId("idle0")), ClientId("idle0"))
        self.hello(ClientId("busy"), ProcessKey(200, 1), "busy")
        self.count = 0

    def tell(self, event: ev.Event) -> list[Effect]:
        self.now += 0.01
        return self.core.handle(event, self.now)

    def counted(self, event: ev.Event) -> int:
        self.count = 0
        before = sys.gettrace()  # that of a coverage run
        sys.settrace(self._trace)
        try:
            self.tell(event)
        finally:
            sys.settrace(before)
        return self.count

    def _trace(self, frame: FrameType, event: str, _: Any) -> Any:
        frame.f_trace_opcodes = True
        self.count += event == "opcode"
        return self._trace

    def request(self) -> RequestId:
        self.requests += 1
        return RequestId(self.requests)

    def reading(self) -> ev.MemorySampled:
        return ev.MemorySampled(GPU, self.now, 0, d.GIB, () if self.listed else None)

    def hello(self, client: ClientId, process: ProcessKey, instance: str) -> None:
        self.tell(ev.ClientConnected(client, process, 0, str(client), instance))

    def asking(self, client: ClientId) -> ev.Asked:
        spec = LeaseSpec(
            consumer="small",
            model_id="m",
            footprint=Footprint(SIZE, SIZE, 0),
            ttl_s=1e9,
            min_residency_s=0.0,
        )
        number = self.request()
        return ev.Asked(client, number, w.Acquire(f"n{number}", spec))

    def acquire(self, client: ClientId) -> tuple[LeaseId, Token]:
        effects = self.tell(self.asking(client))
        bodies = [effect.body for effect in effects if isinstance(effect, Reply)]
        lease = next(body.lease for body in bodies if isinstance(body, AcquireReply))
        assert lease.state == "loading"
        assert lease.token is not None
        return LeaseId(lease.lease_id), lease.token

    def load(self, lease: tuple[LeaseId, Token], client: ClientId) -> None:
        self.tell(ev.Asked(client, self.request(), w.Ready(*lease)))
        self.tell(self.reading())

    def cycle(self) -> dict[str, int]:
        """One client's lease from acquire to the verdict, and a quiet reading."""
        client = ClientId("busy")
        found = {"acquire": self.counted(self.asking(client))}
        lease = max(self.core.inspect().leases.values(), key=lambda lease: lease.request.arrival)
        assert lease.token is not None
        one = (lease.id, lease.token)
        found["ready"] = self.counted(ev.Asked(client, self.request(), w.Ready(*one)))
        found["renew"] = self.counted(
            ev.Asked(client, self.request(), w.Renew((w.LeaseRef(*one),)))
        )
        found["release"] = self.counted(ev.Asked(client, self.request(), w.Release(*one)))
        found["tick"] = self.counted(ev.Tick())
        found["first reading"] = self.counted(self.reading())
        self.tell(ev.Tick())
        found["verdict"] = self.counted(self.reading())
        assert lease.id not in self.core.inspect().leases
        found["quiet reading"] = self.counted(self.reading())
        return found


@pytest.mark.parametrize("listed", [True, False])
def test_no_event_costs_more_beside_a_hundred_times_as_many_leases_and_connections(
    listed: bool,
) -> None:
    few, many = Counted(FEW, listed=listed), Counted(MANY, listed=listed)
    few.cycle()
    many.cycle()
    before, after = few.cycle(), many.cycle()
    grown = {
        name: (before[name], after[name]) for name in before if after[name] > 1.1 * before[name]
    }
    assert not grown, f"instructions with {FEW} and with {MANY}"


def test_clients_come_and_go_at_no_cost_beside_leases_that_others_use() -> None:
    """Each hello of a known instance, each goodbye and each death looked at every lease in use."""

    def cost(leases: int) -> list[int]:
        counted = Counted(leases, listed=True)
        for lease in list(counted.core.inspect().leases.values()):
            assert lease.token is not None
            request = w.UseBegin(lease.id, lease.token, UseId("use"), "work")
            counted.tell(ev.Asked(ClientId("idle0"), counted.request(), request))
        process = ProcessKey(300, 1)
        return [
            counted.counted(event)
            for event in (
                ev.ClientConnected(ClientId("one"), process, 0, "visitor", "same"),
                ev.ClientConnected(ClientId("two"), process, 0, "visitor", "same"),
                ev.ClientLeft(ClientId("two"), "gone"),
                ev.ClientConnected(ClientId("three"), process, 0, "visitor", "same"),
                ev.ProcessDied(process),
            )
        ]

    few, many = cost(FEW), cost(MANY)
    assert all(after <= 1.1 * before for before, after in zip(few, many, strict=True)), (few, many)
