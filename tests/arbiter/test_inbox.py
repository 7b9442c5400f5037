"""The inbox: one event after the other, one timer, and an end when the core fails. The core is
scripted, the loop is real."""

import asyncio
import time
from collections.abc import Awaitable, Callable, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

from tests.support.messages import IDLE_STATUS, no_reason
from tests.support.waiting import PATIENCE_S
from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.arbiter.core.events import ClientLeft, Event, Resumed, Tick
from vram_arbiter.arbiter.inbox import ANSWERS_AT_ONCE, QUESTIONS_MAX, Inbox
from vram_arbiter.schemas.ids import ClientId, GpuId
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply


def left(name: str) -> ClientLeft:
    return ClientLeft(ClientId(name), "bye")


class ScriptedCore:
    """Answers every event with a note of its number; its deadline is whatever the test says."""

    def __init__(self) -> None:
        self.seen: list[Event] = []
        self.times: list[float] = []
        self.deadline: float | None = None
        self.ticked = asyncio.Event()
        self.broken = False
        self.unread: list[GpuId] = []

    def handle(self, event: Event, now: float) -> list[Effect]:
        if self.broken:
            raise RuntimeError("invariant 1")
        self.seen.append(event)
        self.times.append(now)
        if isinstance(event, Tick):
            self.deadline = None
            self.ticked.set()
        return [Note("seen", {"number": len(self.seen)})]

    def next_deadline(self) -> float | None:
        return self.deadline

    def status(self, now: float, *page: object, details: bool = False) -> StatusReply:
        if self.broken:
            raise KeyError("state")
        return replace(IDLE_STATUS, uptime_s=now)

    def stale(self, now: float) -> list[GpuId]:
        return self.unread

    def why(self, consumer: str, now: float) -> WhyReply:
        return no_reason(consumer)


def with_inbox(test: Callable[[Inbox, ScriptedCore, list[Any]], Awaitable[None]]) -> None:
    async def run() -> None:
        core, done = ScriptedCore(), list[Any]()

        def perform(effects: Sequence[Effect]) -> None:
            done.append(effects)
            if len(core.seen) == 1:  # an effect that posts: handled afterwards, not inside
                inbox.post(left("second"))
                done.append("first performed")

        inbox = Inbox(core, perform, done.append)
        async with asyncio.timeout(PATIENCE_S):
            await test(inbox, core, done)
        inbox.close()

    asyncio.run(run())


def test_an_event_that_an_effect_posts_is_handled_after_it() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        inbox.post(left("first"))
        assert core.seen == [left("first"), left("second")]
        assert done[1] == "first performed"

    with_inbox(test)


def test_the_clock_is_monotonic_time() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        before = time.monotonic()
        inbox.post(left("a"))
        assert before <= core.times[0] <= time.monotonic()
        assert inbox.status(None).uptime_s >= core.times[0]
        assert inbox.why("c").consumer == "c"

    with_inbox(test)


def test_a_tick_comes_at_the_deadline_and_not_before() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        deadline = time.monotonic() + 0.05
        core.deadline = deadline
        inbox.post(left("a"))
        await core.ticked.wait()
        assert core.times[-1] >= deadline - 0.001

    with_inbox(test)


def test_an_earlier_deadline_replaces_a_later_one() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        core.deadline = time.monotonic() + 1000
        inbox.post(left("a"))
        core.deadline = time.monotonic() + 0.01
        inbox.post(left("b"))
        await core.ticked.wait()
        core.ticked.clear()
        core.deadline = time.monotonic() - 5  # passed already
        inbox.post(left("c"))
        await core.ticked.wait()
        assert core.seen.count(Tick()) == 2, "one for each deadline that came"

    with_inbox(test)


def test_the_same_deadline_twice_in_a_row_still_ticks() -> None:
    """After a tick the core may name the deadline again that has just come: it must not be taken
    for armed."""

    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        deadline = time.monotonic() + 0.01
        for _ in range(3):
            core.deadline = deadline
            inbox.post(left("a"))
            await core.ticked.wait()
            core.ticked.clear()
        assert core.seen.count(Tick()) == 3, "one for each time that it was named"

    with_inbox(test)


def test_the_core_hears_of_a_suspend_before_anything_else() -> None:
    async def run() -> None:
        core, sleeps = ScriptedCore(), [0.0, 3600.0, 0.0, 7.0, 0.0]
        inbox = Inbox(core, lambda effects: None, lambda error: None, slept_s=lambda: sleeps.pop(0))
        for name in ("evening", "morning"):
            inbox.post(left(name))
        assert core.seen == [left("evening"), Resumed(3600.0), left("morning")]
        inbox.post(left("noon"))
        assert core.seen[3:] == [Resumed(7.0), left("noon")]
        inbox.close()

    asyncio.run(run())


def test_a_daemon_that_did_not_run_says_so_before_it_judges_anybody() -> None:
    """SIGSTOP, swapping, a paused virtual machine: the renewals lie in the socket, and the timer
    that would expire everybody is due."""

    async def run() -> None:
        core, now = ScriptedCore(), [100.0]
        inbox = Inbox(core, lambda effects: None, lambda error: None, lambda: now[0])
        core.deadline = 105.0
        inbox.post(left("a"))
        now[0] = 105.9
        inbox.post(left("busy"))
        assert core.seen == [left("a"), left("busy")], "a little late is only late"
        core.deadline = 110.0
        inbox.post(left("b"))
        now[0] = 130.0
        inbox.post(left("c"))
        inbox.post(left("d"))
        assert core.seen[3:] == [Resumed(20.0), left("c"), left("d")]
        inbox.close()

    asyncio.run(run())


def test_a_pulse_has_passed_through_the_core_and_its_effects() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        inbox.post(left("a"))
        assert inbox.pulse()
        assert core.seen[-1] == Tick()
        assert done[-1] == [Note("seen", {"number": len(core.seen)})]

    with_inbox(test)


def test_there_is_no_pulse_while_an_event_is_being_handled() -> None:
    """An effect that never ends is a stuck daemon, even if something inside it still asks."""

    async def run() -> None:
        pulses = list[bool]()

        def perform(effects: Sequence[Effect]) -> None:
            if not pulses:
                pulses.append(inbox.pulse())

        inbox = Inbox(ScriptedCore(), perform, lambda error: None)
        inbox.post(left("a"))
        assert pulses == [False]
        assert inbox.pulse()
        inbox.close()

    asyncio.run(run())


def test_a_failed_core_and_failed_effects_have_no_pulse() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        core.broken = True
        assert not inbox.pulse()
        assert not inbox.pulse()

    with_inbox(test)

    async def run() -> None:
        def perform(effects: Sequence[Effect]) -> None:
            raise OSError("the socket is gone")

        failed = list[BaseException]()
        inbox = Inbox(ScriptedCore(), perform, failed.append)
        assert not inbox.pulse()
        assert [str(error) for error in failed] == ["the socket is gone"]

    asyncio.run(run())


def test_a_core_that_raises_ends_everything_once() -> None:
    async def test(inbox: Inbox, core: ScriptedCore, done: list[Any]) -> None:
        inbox.post(left("a"))
        done.clear()
        core.broken = True
        inbox.post(left("b"))
        inbox.post(left("c"))
        assert inbox.closed
        assert [str(error) for error in done] == ["invariant 1"]

    with_inbox(test)


def test_what_is_handled_is_recorded_once_its_answers_are_out() -> None:
    """Also where performing it raised, or the engine itself."""

    async def run() -> None:
        def perform(effects: Sequence[Effect]) -> None:
            told.append("performed")
            if len(core.seen) == 2:
                raise OSError("no disk")

        def inbox() -> Inbox:
            return Inbox(core, perform, told.append, record=lambda *what: told.append(what))

        core, told = ScriptedCore(), list[Any]()
        first = inbox()
        first.post(left("a"))
        assert told == ["performed", (core.times[0], left("a"), [Note("seen", {"number": 1})])]
        first.post(left("b"))
        assert told[2:4] == ["performed", (core.times[1], left("b"), [Note("seen", {"number": 2})])]
        assert str(told[4]) == "no disk"
        core.broken = True
        inbox().post(left("c"))
        now, event, effects = told[5]
        assert (event, effects, str(told[6])) == (left("c"), None, "invariant 1")
        assert now >= core.times[1]

    asyncio.run(run())


def test_a_question_waits_for_a_fresh_reading_of_every_gpu() -> None:
    """An idle daemon answered `status` from a reading of minutes ago: a stowaway of 5.4 GiB was
    shown as free memory."""

    async def run() -> None:
        core, asked, answered = ScriptedCore(), list[GpuId](), list[str]()
        inbox = Inbox(core, lambda effects: None, lambda error: None, sample=asked.append)
        core.unread = [GpuId("gpu-0"), GpuId("gpu-1")]
        inbox.when_read(lambda: answered.append("first"))
        inbox.when_read(lambda: answered.append("second"))
        assert asked == core.unread, "one reading of each GPU serves both questions"
        core.unread = [GpuId("gpu-1")]
        inbox.post(left("the reading of one"))
        assert answered == []
        core.unread = []
        inbox.post(left("the reading of the other"))
        assert answered == ["first", "second"]
        inbox.when_read(lambda: answered.append("third"))
        assert (answered[2:], len(asked)) == (["third"], 2), "a fresh reading is not taken again"
        inbox.close()

    asyncio.run(run())


def test_a_gpu_that_does_not_answer_keeps_no_question_waiting() -> None:
    """The answer then shows the reading that there is, with its age."""

    async def run() -> None:
        core, answered = ScriptedCore(), asyncio.Event()
        inbox = Inbox(core, lambda effects: None, lambda error: None)
        core.unread = [GpuId("gpu-0")]
        inbox.when_read(answered.set)
        assert not answered.is_set(), "a reading may still come"
        await asyncio.wait_for(answered.wait(), PATIENCE_S)
        assert core.unread, "none came"
        inbox.close()

    asyncio.run(run())


def test_questions_that_wait_are_bounded() -> None:
    async def run() -> None:
        core, answered = ScriptedCore(), list[int]()
        inbox = Inbox(core, lambda effects: None, lambda error: None)
        core.unread = [GpuId("gpu-0")]
        for _ in range(QUESTIONS_MAX + 1):
            inbox.when_read(lambda: answered.append(1))
        assert answered == [1], "the one beyond the limit is answered at once"
        inbox.close()

    asyncio.run(run())


def test_questions_that_waited_together_are_answered_a_few_at_a_time() -> None:
    """Each answer costs a page of the status: a thousand in one turn of the loop held everybody
    else for a second."""

    async def run() -> None:
        core, answered = ScriptedCore(), list[int]()
        inbox = Inbox(core, lambda effects: None, lambda error: None)
        core.unread = [GpuId("gpu-0")]
        for number in range(3 * ANSWERS_AT_ONCE):
            inbox.when_read(partial(answered.append, number))
        core.unread = []
        inbox.post(left("the reading"))
        assert len(answered) == ANSWERS_AT_ONCE
        await asyncio.sleep(0)
        assert len(answered) == 2 * ANSWERS_AT_ONCE
        await asyncio.sleep(0)
        assert answered == list(range(3 * ANSWERS_AT_ONCE))
        inbox.close()

    asyncio.run(run())
