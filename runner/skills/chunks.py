"""Playback of action chunks: rows aligned with the control steps they were predicted for.

The owner is the control thread: it alone pops rows and asks for the next chunk. A chunk is fetched
elsewhere (`fetch` returns a future at once). With `prefetch_at` 0 the next observation is taken
when the last row was played; with n > 0 it is taken when n rows are left, which play meanwhile.

Row k of a chunk belongs to the k-th control step after its observation. As many of its rows as were
played since are skipped; the next `keep` replace what is left of the chunk before. A step in which
the robot stands still skips no row: the robot is still where the chunk expects it.

In a simulator whose world waits (`wait_s`), when an answer really comes must not decide what an
episode is. There a chunk is taken `latency_steps` control steps after it was asked for, or when the
rows before it are played, as if the policy took that long.

A chunk after the first is a *hit* when it was there as its first row was due, a *miss* when the
robot (or the simulated world) waited.
"""

from __future__ import annotations

import concurrent.futures
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

from vram_arbiter.schemas.errors import ModelError

Row = tuple[float, ...]
Rows = Sequence[Row]
CHUNK_ROWS_MAX = 1000


@dataclass(frozen=True, slots=True)
class Played:
    """A row to play now, and its chunk.

    `first`: it is the first row that is played of its chunk. `prefetched` comes with it for every
    chunk but the first: whether the chunk was in time.
    """

    chunk: int
    row: Row
    first: bool = False
    prefetched: bool | None = None


class ChunkPlayer:
    """Player of one goal's chunks.

    `keep` rows of a chunk are played, behind those that are skipped; None: all. `wait_s` is how
    long `next_row` may wait for a chunk that is due. `latency_steps` counts only with it; None: as
    many steps as there are rows to play when the chunk is asked for.
    """

    def __init__(
        self,
        fetch: Callable[[Any], concurrent.futures.Future[Rows]],
        *,
        prefetch_at: int = 0,
        keep: int | None = None,
        wait_s: float = 0.0,
        latency_steps: int | None = None,
    ) -> None:
        if prefetch_at < 0:
            raise ValueError(f"prefetch_at must be 0 or more, not {prefetch_at}")
        self._fetch = fetch
        self._prefetch_at = prefetch_at
        self._keep = keep
        self._wait_s = wait_s
        self._latency_steps = latency_steps if wait_s else None
        self._rows: deque[tuple[int, Row]] = deque()
        self._cut: Rows = ()  # of the newest chunk: its rows behind those that are played
        self._under_way: concurrent.futures.Future[Rows] | None = None
        self._asked_at = 0  # rows played before the observation of the chunk under way
        self._steps_since = 0  # control steps since then
        self._late = False  # the chunk that is awaited was due and not there
        self._stands = False  # no row was played in the last control step
        self._begun = -1  # the newest chunk of which a row was played
        self.chunks = 0
        self.played = 0

    def wants_observation(self, ahead: int = 0) -> bool:
        """Return whether the next `next_row` will ask for a chunk and so needs an observation.

        With `ahead`, whether it or one of so many after it will, as far as the rows tell: also
        while a chunk is under way, once for every step in which a row plays.
        """
        if self._under_way is not None and (self._stands or not ahead):
            return False
        return len(self._rows) <= self._prefetch_at + ahead

    @property
    def delay(self) -> int:
        """Number of rows that may play before the first row of a chunk that is asked for now."""
        return len(self._rows)

    def left_over(self, limit: int) -> list[Row]:
        """Return what the chunks so far say about the next control steps, at most `limit` of them:
        the rows to be played, then those that were cut off.
        """
        rows = [row for _, row in self._rows]
        return [*rows, *self._cut][:limit]

    def next_row(self, observation: Any) -> Played | None:
        """Return what to play now, or None while the next chunk is pending.

        Raises what the fetch raised.
        """
        if self.wants_observation():
            if observation is None:
                raise ModelError(
                    "no observation for the next chunk", hint="the world state came without frames"
                )
            self._asked_at, self._steps_since = self.played, 0
            self._under_way = self._fetch(observation)
        if (future := self._under_way) is not None:
            if self._due() and not future.done():
                self._late = self._late or not (self._rows or self._latency_steps is not None)
                if self._wait_s:
                    concurrent.futures.wait([future], self._wait_s)
            if self._due() and future.done():
                self._under_way = None
                self._collect(future)
            self._steps_since += 1
        self._stands = not self._rows
        if self._stands:
            self._late = True
            return None
        self.played += 1
        chunk, row = self._rows.popleft()
        if chunk == self._begun:
            return Played(chunk, row)
        late, self._late, self._begun = self._late, False, chunk
        return Played(chunk, row, first=True, prefetched=None if chunk == 0 else not late)

    def _due(self) -> bool:
        """Return whether the chunk under way may be taken in this control step."""
        if not self._wait_s:
            return True
        if self._latency_steps is None:
            return not self._rows
        return self._steps_since >= self._latency_steps

    def _collect(self, future: concurrent.futures.Future[Rows]) -> None:
        """Take the rows of an answered request. Raises what it failed with."""
        self._late = self._late or (
            not self._rows and (future.cancelled() or future.exception() is not None)
        )
        try:
            rows = future.result()
        except (TimeoutError, concurrent.futures.CancelledError) as error:
            raise ModelError("the policy gave no chunk in time") from error
        if not 0 < len(rows) <= CHUNK_ROWS_MAX:
            raise ModelError(f"a chunk of {len(rows)} actions; 1 to {CHUNK_ROWS_MAX} are accepted")
        first = self.played - self._asked_at
        end = len(rows) if self._keep is None else first + self._keep
        if first < len(rows):  # else it says nothing about the steps to come
            self._rows = deque((self.chunks, row) for row in rows[first:end])
            self._cut = rows[end:]
        self.chunks += 1

    def close(self) -> None:
        """Forget everything; a chunk under way is never played."""
        if self._under_way is not None:
            self._under_way.cancel()
            self._under_way = None
        self._rows.clear()
        self._cut = ()
