"""Plays chunks of actions in order: nothing twice, nothing dropped, one request at a time, one owner.

The owner is the control thread: it alone pops rows and asks for the next chunk. A chunk is fetched elsewhere (`fetch` returns a
future at once). With `prefetch_at` 0 the next observation is taken when the last row was played; with n > 0 it is taken when n
rows are left, and the new chunk plays after them. Any chunk size works with any `prefetch_at`.
"""

from __future__ import annotations

import concurrent.futures
from collections import deque
from collections.abc import Callable, Sequence
from typing import Any

from schemas.errors import ModelError

Row = tuple[float, ...]
Rows = Sequence[Row]
CHUNK_ROWS_MAX = 1000


class ChunkPlayer:
    """`wait_s` is how long `next_row` may wait for a chunk that is under way: in a simulator the world waits with it."""

    def __init__(
        self,
        fetch: Callable[[Any], concurrent.futures.Future[Rows]],
        *,
        prefetch_at: int = 0,
        wait_s: float = 0.0,
    ) -> None:
        if prefetch_at < 0:
            raise ValueError(f"prefetch_at must be 0 or more, not {prefetch_at}")
        self._fetch = fetch
        self._prefetch_at = prefetch_at
        self._wait_s = wait_s
        self._rows: deque[tuple[int, Row]] = deque()
        self._under_way: concurrent.futures.Future[Rows] | None = None
        self.chunks = 0
        self.played = 0

    def wants_observation(self) -> bool:
        """Whether the next `next_row` will ask for a chunk and so needs an observation."""
        return self._under_way is None and len(self._rows) <= self._prefetch_at

    def next_row(self, observation: Any) -> tuple[int, Row] | None:
        """(index of the chunk, row) to play now, or None while the next chunk is awaited. Raises what the fetch raised."""
        if self.wants_observation():
            if observation is None:
                raise ModelError(
                    "no observation for the next chunk", hint="the world state came without frames"
                )
            self._under_way = self._fetch(observation)
        if not self._rows:
            self._collect(self._wait_s)
        elif self._under_way is not None and self._under_way.done():
            self._collect(0.0)
        if not self._rows:
            return None
        self.played += 1
        return self._rows.popleft()

    def _collect(self, wait_s: float) -> None:
        if (future := self._under_way) is None:
            return
        try:
            rows = future.result(timeout=wait_s)
        except concurrent.futures.TimeoutError:
            if future.done():  # the fetch itself timed out: that is an answer
                self._under_way = None
                raise ModelError("the policy gave no chunk in time") from None
            return
        except BaseException:
            self._under_way = None
            raise
        self._under_way = None
        if not 0 < len(rows) <= CHUNK_ROWS_MAX:
            raise ModelError(f"a chunk of {len(rows)} actions; 1 to {CHUNK_ROWS_MAX} are accepted")
        self._rows.extend((self.chunks, row) for row in rows)
        self.chunks += 1

    def close(self) -> None:
        """Forget everything; a chunk under way is never played."""
        if self._under_way is not None:
            self._under_way.cancel()
            self._under_way = None
        self._rows.clear()
