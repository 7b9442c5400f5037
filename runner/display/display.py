"""Live view of a runner: ticks of goals, the state between them, leases, in a thread of its own.

The control thread only appends to a bounded queue: with half of it taken ticks lose their pictures,
beyond that ticks are left out, and both are counted. A viewer that hangs or leaves costs the robot
nothing. Must not know sockets or robots.
"""

from __future__ import annotations

import logging
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

from vram_arbiter.runner.display.stream import RerunStream
from vram_arbiter.runner.protocols import Goal, GoalData, GoalTick, SkillEnded
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.world import WorldState

log = logging.getLogger(__name__)

QUEUE_TICKS = 60  # two seconds at 30 Hz
PICTURES_UNTIL = QUEUE_TICKS // 2
IDLE_S = 0.2  # between goals the state is shown so often
CLOSE_S = 60.0  # importing it may take half of that on a busy machine


class Display:
    """Implements `runner.protocols.TickSink`. `latest` is read between goals, on its thread.

    `make` makes the stream on that thread: a viewer takes seconds to start.
    """

    def __init__(
        self, make: Callable[[], RerunStream], latest: Callable[[], WorldState | None]
    ) -> None:
        self._make = make
        self._latest = latest
        self._changed = threading.Condition()
        self._queue: deque[Callable[[RerunStream], None]] = deque()
        self._closing = False
        self._broken = False
        self._goal_id = ""
        self._idle_stamp = 0
        self._charged: Mapping[str, float] = {}
        self.dropped_pictures = 0  # of ticks
        self.dropped_ticks = 0
        self._thread = threading.Thread(target=self._main, name="display", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Show what is queued and end, at most CLOSE_S. Repeatable."""
        with self._changed:
            self._closing = True
            self._changed.notify()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive():
            log.warning("the viewer has not taken everything within %.0f s", CLOSE_S)
        if self.dropped_ticks or self.dropped_pictures:
            log.warning(
                "the viewer was too slow: %d ticks without their pictures, %d ticks not shown",
                self.dropped_pictures,
                self.dropped_ticks,
            )

    # -- control thread
    def tick(self, tick: GoalTick) -> None:
        """See `runner.protocols.TickSink`."""
        with self._changed:
            if self._closing or self._broken:
                return
            if len(self._queue) >= QUEUE_TICKS:
                self.dropped_ticks += 1
                return
            if len(self._queue) >= PICTURES_UNTIL:
                self.dropped_pictures += 1
                tick = replace(tick, world=tick.world.model_copy(update={"image_frames": None}))
            self._queue.append(lambda stream: self._show_tick(stream, tick))
            self._changed.notify()

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        """See `runner.protocols.TickSink`."""
        self._put(lambda stream: self._show_end(stream, goal, ended))

    def facts(self) -> GoalData:
        """Return an empty map: a view adds nothing to the result."""
        return {}

    # -- any thread
    def leases(self, charged: Mapping[str, float]) -> None:
        """Show the bytes that leases are charged now, by holder."""
        now_s = time.monotonic()
        self._put(lambda stream: self._show_leases(stream, dict(charged), now_s))

    def _put(self, item: Callable[[RerunStream], None]) -> None:
        with self._changed:
            if not self._closing and not self._broken and len(self._queue) < 2 * QUEUE_TICKS:
                self._queue.append(item)
                self._changed.notify()

    # -- its own thread
    def _main(self) -> None:
        try:
            stream = self._make()
            try:
                while (show := self._next()) is not None:
                    show(stream)
            finally:
                stream.close()
        except VramError as error:
            log.error("nothing more is displayed: %s", error)
            self._stop()
        except Exception:
            log.exception("nothing more is displayed")
            self._stop()

    def _stop(self) -> None:
        with self._changed:
            self._broken = True
            self._queue.clear()

    def _next(self) -> Callable[[RerunStream], None] | None:
        """Return what is shown next: the idle state when there was nothing for a while; None at the
        end.
        """
        with self._changed:
            self._changed.wait_for(lambda: bool(self._queue) or self._closing, IDLE_S)
            if self._queue:
                return self._queue.popleft()
            return None if self._closing else self._show_idle

    def _show_tick(self, stream: RerunStream, tick: GoalTick) -> None:
        goal = tick.goal
        stream.tick(tick)
        if goal.goal_id != self._goal_id:
            self._goal_id = goal.goal_id
            stream.goal(f"{goal.rskill_id}: {goal.prompt}\n\n{goal.goal_id}")
            stream.event(f"goal {goal.goal_id}: {goal.rskill_id} {goal.prompt}".rstrip())

    def _show_end(self, stream: RerunStream, goal: Goal, ended: SkillEnded | None) -> None:
        self._goal_id = ""
        error = ended.error if ended is not None else None
        said = "taken back" if ended is None else str(error or "succeeded")
        stream.goal(f"idle, after {goal.rskill_id}: {said}")
        stream.event(f"goal {goal.goal_id}: {said}", "INFO" if error is None else "ERROR")

    def _show_leases(self, stream: RerunStream, charged: Mapping[str, float], at_s: float) -> None:
        stream.at(at_s)
        gone = dict.fromkeys(self._charged.keys() - charged.keys(), 0.0)
        for name in charged.keys() - self._charged.keys():
            stream.event(f"lease {name}: granted")
        for name in gone:
            stream.event(f"lease {name}: ended")
        self._charged = charged
        stream.leases({**charged, **gone})

    def _show_idle(self, stream: RerunStream) -> None:
        world = self._latest()
        if world is not None and world.stamp_ns > self._idle_stamp:
            self._idle_stamp = world.stamp_ns
            stream.at(world.stamp_ns / 1e9)
            stream.world(world)
