"""One decision of the core alone, in this process: 100 leases and 1,000 waiters, and how its cost
grows with ten times as many."""

import math
import random
import time
from typing import Any

from tests.bench.harness import SLIVER, Suite, p50
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Push, Reply, Sample
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.pushes import GrantedPush
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

GPU = GpuId("GPU-0")
STEP_S = 0.001
PER_CLIENT = 50


class Bench:
    """A core with `leases` holders, all in use, on a full GPU, and `waiters` of whom none fits."""

    def __init__(self, leases: int, waiters: int) -> None:
        self.capacity = leases * SLIVER
        gpu = GpuInfo(GPU, 0, "bench", self.capacity, 0)
        settings = Settings(
            epoch=1, gpus=(gpu,), leases_per_client_max=PER_CLIENT, verify_tolerance_bytes=0
        )
        self.core = Arbiter(settings, 0.0)
        self.now = 1.0
        self.requests = 0
        self.tokens: dict[LeaseId, tuple[ClientId, Token]] = {}
        self.queued: list[tuple[ClientId, LeaseId]] = []
        self.samples: dict[str, list[float]] = {}
        clients = [ClientId(f"{n:04x}") for n in range((leases + 2 * waiters) // PER_CLIENT + 4)]
        # waiters hold nothing, so that none blocks itself
        holders = leases // PER_CLIENT + 1
        for number, client in enumerate(clients):
            process = ProcessKey(1000 + number, 1)
            self.handle(ev.ClientConnected(client, process, 0, f"c{number}", f"i{number}"))
        self.read()
        for number in range(leases):
            lease = self.acquire(clients[number % holders], SLIVER)
            client, token = self.tokens[lease]
            self.handle(self.asked(client, w.Ready(lease, token)))
            self.handle(self.asked(client, w.UseBegin(lease, token, UseId("u"))))
        for number in range(waiters):
            self.acquire(clients[holders + number % (len(clients) - holders)], 2 * SLIVER)
        self.samples.clear()

    def asked(self, client: ClientId, request: w.AnyRequest) -> ev.Asked:
        self.requests += 1
        return ev.Asked(client, RequestId(self.requests), request)

    def handle(self, event: ev.Event) -> list[Any]:
        self.now += STEP_S
        start = time.perf_counter()
        effects = self.core.handle(event, self.now)
        kind = type(event.request if isinstance(event, ev.Asked) else event)
        self.samples.setdefault(kind.__name__, []).append((time.perf_counter() - start) * 1e6)
        for effect in effects:
            if isinstance(effect, Push) and isinstance(effect.body, GrantedPush):
                raise RuntimeError("nobody fits on this GPU")
        if any(isinstance(effect, Sample) for effect in effects):
            self.read()
        return effects

    def read(self) -> None:
        self.handle(ev.MemorySampled(GPU, self.now, 0, self.capacity, None))

    def acquire(self, client: ClientId, size: int) -> LeaseId:
        spec = LeaseSpec(
            consumer="bench", model_id="m", footprint=Footprint(size, size, 0), ttl_s=1e9,
            min_residency_s=0.0,
        )  # fmt: skip
        event = self.asked(client, w.Acquire(f"n{self.requests + 1}", spec))
        reply = next(effect for effect in self.handle(event) if isinstance(effect, Reply))
        assert isinstance(reply.body, AcquireReply)
        view = reply.body.lease
        lease = LeaseId(view.lease_id)
        if view.state == "loading" and view.token is not None:
            self.tokens[lease] = (client, view.token)
        else:
            self.queued.append((client, lease))
        return lease

    def mix(self, rounds: int) -> None:
        """What a busy GPU sees: renewals, uses, waiters that come and give up, readings."""
        dice = random.Random(7)
        held = list(self.tokens)
        for _ in range(rounds):
            lease = held[dice.randrange(len(held))]
            client, token = self.tokens[lease]
            self.handle(self.asked(client, w.Renew((w.LeaseRef(lease, token),))))
            self.handle(self.asked(client, w.UseBegin(lease, token, UseId("v"))))
            self.handle(self.asked(client, w.UseEnd(lease, token, UseId("v"))))
            place = dice.randrange(len(self.queued))
            self.queued[place], self.queued[-1] = self.queued[-1], self.queued[place]
            client, waiting = self.queued.pop()
            self.handle(self.asked(client, w.Cancel(waiting)))
            self.acquire(client, 2 * SLIVER)
            self.read()


def run(suite: Suite) -> None:
    rounds = suite.size(400, 40)
    small, large = Bench(100, 1000), Bench(1000, 10_000)
    for _ in range(4):
        small.mix(rounds // 4)
        large.mix(rounds // 4)
    size = "100 leases, 1,000 waiters"
    for kind, samples in sorted(small.samples.items()):
        suite.time(f"core: {kind}, {size}", samples)
    suite.limit(f"core: one decision, {size}", everything(small), p99_max_us=1000.0)
    growth = p50(everything(large)) / p50(everything(small))
    allowed = math.log(11_000) / math.log(1100)
    name = "core: growth with ten times as many"
    suite.figure(name, growth, "x", at_most=round(allowed, 2), note="no faster than log n")


def everything(bench: Bench) -> list[float]:
    return [took for samples in bench.samples.values() for took in samples]
