"""The one place that owns the engine: events in, one after the other, effects out to the executor,
one timer for time.

All of it runs on the thread of the event loop; other threads post through
`loop.call_soon_threadsafe(inbox.post, event)`. Nothing else calls the engine, except for its
reads. `now` is `time.monotonic()`: the clock of the event loop's timers and of the readings' time
stamps. That clock stands still while the machine is suspended, so nothing expires over night, and
`SuspendWatch` notices that the night was there.
"""

import asyncio
import json
import logging
import re
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Event, Resumed, Tick
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import STATUS_DETAILS_PAGE, STATUS_PAGE
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import StatusReply

log = logging.getLogger(__name__)

NOTICED_S = 1.0
"""A shorter sleep of the machine changes nothing that a reading of the GPU would show."""
HELD_UP_S = 1.0
"""A daemon that wakes up so late did not run meanwhile (stopped, swapped out, a paused virtual
machine). It heard no client, so no client's silence counts: the engine is told that it slept."""
TIMER_FLOOR_S = 0.0002
"""A deadline that has passed is served this soon, and not in a busy loop."""

FRESH_S = 1.0
"""Time limit for the reading that an answer waits for. After it the answer shows the old reading
with its age."""
ANSWERS_AT_ONCE = 4
QUESTIONS_MAX = 1024
"""Answers that wait for a reading at a time. One more is given at once, with the reading that there
is."""
NO_READER = ProcessKey(0, 0)
"""Reader of a status that goes to the log: it may see no token."""
_DUE = Tick()
"""The timer's own event."""
_boottime = partial(time.clock_gettime, time.CLOCK_BOOTTIME)
_TOKEN = re.compile(r"Token\(epoch=(\d+), serial=\d+\)")


class SuspendWatch:
    """`slept_s()` gives the seconds slept since it was last asked, each sleep once; 0.0 if there
    was none. CLOCK_BOOTTIME runs on while the machine sleeps, CLOCK_MONOTONIC does not."""

    def __init__(
        self,
        boottime: Callable[[], float] = _boottime,
        monotonic: Callable[[], float] = time.monotonic,
    ) -> None:
        self._boottime = boottime
        self._monotonic = monotonic
        self._lead_s = boottime() - monotonic()

    def slept_s(self) -> float:
        # a thread that is held up between the two readings sees less of the lead, never more: no
        # sleep is made up
        boottime = self._boottime()
        lead_s = boottime - self._monotonic()
        slept_s = lead_s - self._lead_s
        if slept_s < NOTICED_S:
            return 0.0
        self._lead_s = lead_s
        return slept_s


def without_tokens(event: Event) -> str:
    """An event as the log may show it: a token authorizes uses, and the log has more readers than
    the lease."""
    return _TOKEN.sub(r"Token(epoch=\1, …)", repr(event))


class Inbox:
    """Owns the engine.

    `perform` runs the effects of one event; it may post events, which are handled after it
    returned. `failed` is called once with the exception if the engine raises: its state can no
    longer be trusted, so nothing is handled after that. `slept_s` tells for how long the machine
    was suspended since it was last asked; the engine hears of it, and of a stop of this process
    alone, before any other event. `record` is told of every event and what came of it (None: the
    engine raised) once that is performed: no answer waits for it. `sample` begins a reading of a
    GPU, which ends in an event (`MemorySampled` or `ProbeFailed`).
    """

    def __init__(
        self,
        core: Arbiter,
        perform: Callable[[Sequence[Effect]], None],
        failed: Callable[[BaseException], None],
        clock: Callable[[], float] = time.monotonic,
        slept_s: Callable[[], float] = lambda: 0.0,
        record: Callable[[float, Event, Sequence[Effect] | None], None] | None = None,
        sample: Callable[[GpuId], None] = lambda gpu: None,
    ) -> None:
        self._core = core
        self.perform = perform
        self.sample = sample
        self._failed = failed
        self._clock = clock
        self._slept_s = slept_s
        self._record = record
        self._queue: deque[Event] = deque()
        self._busy = False
        self.closed = False
        self._timer: asyncio.TimerHandle | None = None
        self._deadline: float | None = None
        self._wakes_at: float | None = None  # when the timer is to fire
        self._handled = 0
        self._questions: list[Callable[[], None]] = []  # answered after the next reading
        self._questions_timer: asyncio.TimerHandle | None = None

    def post(self, event: Event) -> None:
        """Handle an event now, or right after the one that is being handled."""
        if self.closed:
            return
        if event is _DUE:
            self._timer = None
        self._queue.append(event)
        if self._busy:
            return
        self._busy = True
        try:
            while self._queue and not self.closed:
                # before anything is decided on what was known yesterday
                slept_s = self._slept_s()
                late_s = 0.0 if self._wakes_at is None else self._clock() - self._wakes_at
                if late_s >= HELD_UP_S:
                    self._wakes_at, slept_s = None, max(slept_s, late_s)  # said once
                if slept_s:
                    self._queue.appendleft(Resumed(slept_s))
                self._handle(self._queue.popleft())
        finally:
            self._busy = False
        if self._questions and not self._core.stale(self._clock()):
            self._answer()
        self._arm()

    def when_read(self, answer: Callable[[], None]) -> None:
        """Call `answer` once every GPU has a fresh reading, or after FRESH_S. It is called at once
        if all readings are fresh.

        An idle daemon reads its GPUs seldom: without this, `status` shows what was there minutes
        ago as the present.
        """
        stale = [] if self.closed else self._core.stale(self._clock())
        if not stale or len(self._questions) >= QUESTIONS_MAX:
            answer()
            return
        self._questions.append(answer)
        if len(self._questions) == 1:  # later questions wait for the same readings
            self._questions_timer = asyncio.get_running_loop().call_later(FRESH_S, self._answer)
            for gpu in stale:
                self.sample(gpu)

    def status(
        self,
        reader: ProcessKey | None,
        after: tuple[int, float, int] | None = None,
        *,
        details: bool = False,
    ) -> StatusReply:
        """A page of the status as `reader` may see it; None: an operator."""
        limit = STATUS_DETAILS_PAGE if details else STATUS_PAGE
        return self._core.status(self._clock(), reader, after, limit, details=details)

    def why(self, consumer: str) -> WhyReply:
        return self._core.why(consumer, self._clock())

    def concerns(self, client: ClientId) -> bool:
        return self._core.concerns(client)

    def pulse(self) -> bool:
        """Send an event through the engine and have its effects performed: True only if both came
        back. What feeds the watchdog: an engine, a journal or a loop that is stuck never gets here,
        and one that failed answers False.
        """
        before = self._handled
        self.post(Tick())
        return self._handled > before

    def close(self) -> None:
        """Nothing is handled from here on; what was granted stays granted in the journal."""
        self.closed = True
        self._queue.clear()
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._forget_questions()

    def _handle(self, event: Event) -> None:
        now, effects = self._clock(), None
        try:
            try:
                effects = self._core.handle(event, now)
                self.perform(effects)
            finally:
                if self._record is not None:
                    self._record(now, event, effects)
            self._handled += 1
        except Exception as error:  # outermost: an engine that raised has an unknown state
            log.critical("the core failed on %s: %s", without_tokens(event), error, exc_info=error)
            log.critical("state of the core: %s", self._state())
            self.close()
            self._failed(error)

    def _answer(self) -> None:
        self._answer_some(self._forget_questions())

    def _answer_some(self, questions: list[Callable[[], None]]) -> None:
        """A few in one turn of the loop: a thousand that waited for the same reading must not hold
        it for a second."""
        for answer in questions[:ANSWERS_AT_ONCE]:
            answer()
        if rest := questions[ANSWERS_AT_ONCE:]:
            asyncio.get_running_loop().call_soon(self._answer_some, rest)

    def _forget_questions(self) -> list[Callable[[], None]]:
        questions, self._questions = self._questions, []
        if self._questions_timer is not None:
            self._questions_timer.cancel()
            self._questions_timer = None
        return questions

    def _state(self) -> str:
        try:
            return json.dumps(to_map(self.status(NO_READER)), default=str)
        # the state may be what is broken; this is its last word
        except Exception as error:  # noqa: BLE001
            return f"unreadable: {error!r}"

    def _arm(self) -> None:
        """One timer for the engine's next deadline; armed again only when that has changed."""
        if self.closed:
            return
        deadline = self._core.next_deadline()
        if deadline == self._deadline and (self._timer is not None or deadline is None):
            return
        if self._timer is not None:
            self._timer.cancel()
            self._timer = None
        self._deadline, self._wakes_at = deadline, None
        if deadline is not None:
            loop = asyncio.get_running_loop()
            wait_s = max(TIMER_FLOOR_S, deadline - self._clock())
            self._wakes_at = self._clock() + wait_s
            self._timer = loop.call_later(wait_s, self.post, _DUE)
