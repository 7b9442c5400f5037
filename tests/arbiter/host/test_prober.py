"""Readings with deadlines: failing, hanging and late probes. Threads are real, the probe is
scripted."""

import asyncio
import os
import queue
import threading
import time
from collections.abc import Awaitable, Callable, Set

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.arbiter.host.prober import Prober
from vram_arbiter.arbiter.host.process_tree import read_kin
from vram_arbiter.schemas.errors import ProbeFailed
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.wire.views import SensorsView

GPU = GpuId("GPU-1")


class ScriptedProbe:
    """`sample` announces itself on `began` and returns what is put on `answers`."""

    def __init__(self) -> None:
        self.began: queue.SimpleQueue[float] = queue.SimpleQueue()
        self.answers: queue.SimpleQueue[Reading | Exception] = queue.SimpleQueue()
        self.calls = 0
        self.closed = threading.Event()

    def gpus(self) -> tuple[GpuDevice, ...]:
        return (GpuDevice(GPU, 0, "scripted", 100),)

    def sample(self, gpu: GpuId) -> Reading:
        assert gpu == GPU
        self.calls += 1
        self.began.put(time.monotonic())
        answer = self.answers.get(timeout=PATIENCE_S)
        if isinstance(answer, Exception):
            raise answer
        return answer

    def sensors(self, gpu: GpuId) -> SensorsView:
        return SensorsView()

    def close(self) -> None:
        self.closed.set()


Posted = "asyncio.Queue[ev.Event]"


def probing(
    test: Callable[[Prober, ScriptedProbe, Posted], Awaitable[None]],
    deadline_s: float = PATIENCE_S,
    owners: Callable[[GpuId], Set[ProcessKey]] = lambda _: frozenset(),
) -> None:
    async def run() -> None:
        probe = ScriptedProbe()
        posted: asyncio.Queue[ev.Event] = asyncio.Queue()
        prober = Prober(
            probe,
            [GPU],
            deadline_s,
            asyncio.get_running_loop(),
            posted.put_nowait,
            owners,
            frozenset,
            lambda _: {},
        )
        async with asyncio.timeout(PATIENCE_S):
            await test(prober, probe, posted)
        prober.close()
        for _ in range(3):
            probe.answers.put(Reading(0, 100, ()))  # lets a hanging thread end
        assert probe.closed.is_set()

    asyncio.run(run())


async def began(probe: ScriptedProbe) -> float:
    return await asyncio.to_thread(probe.began.get, True, PATIENCE_S)


def test_a_reading_is_stamped_with_the_time_before_it_began() -> None:
    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        asked_at = time.monotonic()
        prober.sample(GPU)
        began_at = await began(probe)
        probe.answers.put(Reading(40, 100, ()))
        event = await posted.get()
        assert isinstance(event, ev.MemorySampled)
        assert asked_at <= event.taken_at <= began_at
        assert (event.gpu, event.used_bytes, event.total_bytes, event.processes) == (
            GPU,
            40,
            100,
            (),
        )

    probing(test)


def test_a_question_after_the_reading_began_gets_a_fresh_reading_and_many_share_one() -> None:
    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        prober.sample(GPU)
        await began(probe)
        asked_at = time.monotonic()
        for _ in range(5):
            prober.sample(GPU)
        probe.answers.put(Reading(1, 100, ()))
        first = await posted.get()
        assert isinstance(first, ev.MemorySampled)
        assert first.taken_at < asked_at
        await began(probe)
        probe.answers.put(Reading(2, 100, ()))
        second = await posted.get()
        assert isinstance(second, ev.MemorySampled)
        assert second.taken_at >= asked_at
        assert probe.calls == 2
        assert posted.empty()

    probing(test)


@pytest.mark.parametrize(
    ("error", "reason"),
    [
        (ProbeFailed("driver says no"), "driver says no"),
        (ZeroDivisionError("x"), "ZeroDivisionError: x"),
    ],
)
def test_a_failing_reading_is_unknown_and_the_next_one_is_tried(
    error: Exception, reason: str
) -> None:
    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        prober.sample(GPU)
        probe.answers.put(error)
        event = await posted.get()
        assert isinstance(event, ev.ProbeFailed)
        assert event.reason == reason
        prober.sample(GPU)
        probe.answers.put(Reading(3, 100, None))
        assert isinstance(await posted.get(), ev.MemorySampled)

    probing(test)


def test_a_hanging_reading_is_unknown_until_a_fresh_one_answers() -> None:
    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        prober.sample(GPU)
        await began(probe)
        event = await posted.get()
        assert isinstance(event, ev.ProbeFailed)
        assert "no answer within" in event.reason
        prober.sample(GPU)
        prober.sample(GPU)
        event = await posted.get()
        assert isinstance(event, ev.ProbeFailed)
        assert "hangs since" in event.reason
        assert probe.calls == 1, "no second call into a driver that hangs"
        for reader in prober._readers.values():
            reader._deadline_s = (
                PATIENCE_S  # from here on nothing hangs, however slow this machine is
            )
        probe.answers.put(Reading(1, 100, ()))  # the late answer
        await began(probe)
        assert posted.empty(), "it is as old as its question: not used"
        probe.answers.put(Reading(2, 100, ()))
        event = await posted.get()
        assert isinstance(event, ev.MemorySampled)
        assert event.used_bytes == 2

    probing(test, deadline_s=0.1)


def test_bytes_of_a_child_are_booked_on_who_holds_the_lease_when_the_reading_is_handed_on() -> None:
    """This very process is the child, the test's parent holds the lease, and was granted it while
    the GPU was being read."""
    me, parent = read_kin(os.getpid()), read_kin(os.getppid())
    assert me is not None
    assert parent is not None
    known: set[ProcessKey] = set()
    asked_on: list[int] = []

    def owners(gpu: GpuId) -> Set[ProcessKey]:
        asked_on.append(threading.get_ident())
        return known

    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        use = ev.ProcessUse(me.process, "child", 40)
        prober.sample(GPU)
        await began(probe)
        known.add(parent.process)
        probe.answers.put(Reading(40, 100, (use,)))
        event = await posted.get()
        assert isinstance(event, ev.MemorySampled)
        assert event.processes == (ev.ProcessUse(parent.process, f"{parent.name} (child)", 40),)
        known.clear()
        prober.sample(GPU)
        probe.answers.put(Reading(40, 100, (use,)))
        event = await posted.get()
        assert isinstance(event, ev.MemorySampled)
        assert event.processes == (use,)
        assert set(asked_on) == {threading.get_ident()}, "the core is asked on its own thread only"

    probing(test, owners=owners)


def test_closing_does_not_wait_for_a_hanging_driver() -> None:
    async def test(prober: Prober, probe: ScriptedProbe, posted: Posted) -> None:
        prober.sample(GPU)
        await began(probe)
        began_at = time.monotonic()
        prober.close()
        assert time.monotonic() - began_at < PATIENCE_S / 2
        prober.sample(GPU)
        assert probe.calls == 1

    probing(test)
