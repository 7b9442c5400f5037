"""Whatever sizes chunks have, whenever answers come, wherever requests fail: each row plays in the
step that it was predicted for, and the play goes on.

A row is predicted for the step that is as many rows behind its observation as its place in the
chunk; steps are counted in rows played, as the robot moves by nothing else. A chunk counts as in
time exactly if the robot did not have to stand still before it: told by what was played, not by the
player.
"""

import concurrent.futures
from typing import Any

from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.runner.skills.chunks import ChunkPlayer, Played
from vram_arbiter.schemas.errors import Evicted

Row = tuple[float, ...]
ROWS_MAX = 60


class Answers:
    """Answers the n-th request after `delays[n]` further steps (0: before the next one, None: at
    once); -1 fails it after one step.
    """

    def __init__(self, sizes: list[int], delays: list[int | None]) -> None:
        self.sizes, self.delays = sizes, delays
        self.asked = 0
        self.chunk = 0
        self.failures = 0
        self._future: concurrent.futures.Future[list[Row]] | None = None
        self._left: int | None = None

    def fetch(self, step: Any) -> Any:
        self._asked_at = step
        assert self._future is None or self._future.done(), "one request at a time"
        self._future = concurrent.futures.Future()
        self._left = self.delays[self.asked % len(self.delays)]
        self.asked += 1
        if self._left is None:
            self._answer()
        return self._future

    def step(self) -> None:
        """A tick passes."""
        if self._future is None or self._future.done() or self._left is None:
            return
        if self._left == -1:
            self.failures += 1
            self._future.set_exception(Evicted("gone"))
        elif self._left == 0:
            self._answer()
        else:
            self._left -= 1

    def _answer(self) -> None:
        assert self._future is not None
        size = self.sizes[self.chunk % len(self.sizes)]
        rows = [(float(self.chunk), float(self._asked_at + i)) for i in range(size)]
        self.chunk += 1
        self._future.set_result(rows)


@given(
    sizes=st.lists(st.integers(1, 20), min_size=1, max_size=6),
    prefetch_at=st.integers(0, 30),
    delays=st.lists(st.one_of(st.none(), st.integers(0, 12)), min_size=1, max_size=6),
    failing=st.sets(st.integers(0, 5), max_size=2),
    keep=st.one_of(st.none(), st.integers(1, 8)),
)
@settings(max_examples=150, deadline=None)
def test_any_sizes_any_prefetch_any_lateness(
    sizes: list[int],
    prefetch_at: int,
    delays: list[int | None],
    failing: set[int],
    keep: int | None,
) -> None:
    failed: list[int | None] = [-1 if n in failing else delay for n, delay in enumerate(delays)]
    if all(delay == -1 for delay in failed):
        failed.append(0)
    answers = Answers(sizes, failed)
    player = ChunkPlayer(answers.fetch, prefetch_at=prefetch_at, keep=keep)
    played: list[Played] = []
    stood_still, failures = False, 0
    # each row costs at most one request, each request at most 13 steps and one failure before it
    for _ in range(ROWS_MAX * 13 * len(failed)):
        try:
            row = player.next_row(len(played))
        except Evicted:
            failures += 1
            stood_still = player.delay == 0  # else the failed one was not yet due
        else:
            if row is not None:
                played.append(row)
                first = len(played) == 1 or played[-2].chunk != row.chunk
                assert row.prefetched == ((not stood_still) if first and row.chunk > 0 else None)
                assert row.row == (row.chunk, len(played) - 1)
            stood_still = row is None
        if len(played) == ROWS_MAX:
            break
        answers.step()
    assert len(played) == ROWS_MAX, "it must not come to a stop"
    assert player.played == ROWS_MAX
    assert player.chunks <= answers.chunk <= player.chunks + 1
    assert answers.failures - failures in (0, 1), (
        "a failure is said once; the last may not have been seen yet"
    )


@given(size=st.integers(1, 8), prefetch_at=st.integers(0, 20))
@settings(max_examples=20, deadline=None)
def test_answers_of_another_thread_that_are_waited_for(size: int, prefetch_at: int) -> None:
    with concurrent.futures.ThreadPoolExecutor(1) as pool:

        def fetch(step: Any) -> Any:
            return pool.submit(lambda: [(float(step + i),) for i in range(size)])

        player = ChunkPlayer(fetch, prefetch_at=prefetch_at, wait_s=60.0)
        rows = [player.next_row(step) for step in range(40)]
    assert [row.row for row in rows if row is not None] == [(n,) for n in range(40)]
