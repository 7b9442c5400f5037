"""Each row plays in the control step that it was predicted for, whatever size chunks have and
whenever they come.
"""

import concurrent.futures
from typing import Any

import pytest

from vram_arbiter.runner.skills.chunks import ChunkPlayer, Played
from vram_arbiter.schemas.errors import ModelError

Row = tuple[float, ...]


class Policy:
    """Hands out futures; answers when told. Chunk n holds rows (n, 0), (n, 1), …"""

    def __init__(self, size: int) -> None:
        self.size = size
        self.asked: list[Any] = []
        self.futures: list[concurrent.futures.Future[list[Row]]] = []

    def fetch(self, observation: Any) -> Any:
        assert all(future.done() for future in self.futures), "one request at a time"
        self.asked.append(observation)
        future: concurrent.futures.Future[list[Row]] = concurrent.futures.Future()
        self.futures.append(future)
        return future

    def answer(self) -> None:
        number = len(self.futures) - 1
        self.futures[-1].set_result([(float(number), float(i)) for i in range(self.size)])


def rows_of(player: ChunkPlayer, policy: Policy, rows: int, delay: int = 0) -> list[Row]:
    """Return the next rows; each request is answered `delay` steps after its own."""
    played: list[Row] = []
    waited = 0
    for step in range(rows * (delay + 2)):
        if policy.futures and not policy.futures[-1].done():
            waited += 1
            if waited > delay:
                policy.answer()
                waited = 0
        if (row := player.next_row(step)) is not None:
            assert row.chunk == int(row.row[0])
            played.append(row.row)
        if len(played) == rows:
            return played
    raise AssertionError("the play came to a stop")


def test_a_chunk_that_is_asked_for_early_plays_from_the_step_where_it_begins() -> None:
    """Regression: it played from its row 0, which was predicted for a step two rows ago, so that
    the robot went through those again: a grab of 32 steps took 44.
    """
    policy = Policy(6)
    player = ChunkPlayer(policy.fetch, prefetch_at=2, keep=3)
    assert rows_of(player, policy, 9) == [
        (0, 0), (0, 1),
        (1, 1), (1, 2),  # asked for before (0, 1), there after it: it begins at its row 1
        (2, 1), (2, 2), (3, 1), (3, 2), (4, 1),
    ]  # fmt: skip
    policy = Policy(6)
    player = ChunkPlayer(policy.fetch, prefetch_at=2, keep=3)
    assert rows_of(player, policy, 6, delay=1) == [(0, 0), (0, 1), (0, 2), (1, 2), (1, 3), (1, 4)]


def test_a_world_that_waits_is_the_same_whenever_answers_come() -> None:
    """A chunk that came early was played early: an episode depended on the machine's load."""
    played = []
    for delay in (0, 1):
        policy = Policy(6)
        player = ChunkPlayer(policy.fetch, prefetch_at=2, keep=3, wait_s=1e-9)
        played.append(rows_of(player, policy, 6, delay))
    assert played[0] == played[1] == [(0, 0), (0, 1), (0, 2), (1, 2), (1, 3), (1, 4)]


@pytest.mark.parametrize(
    ("prefetch_at", "latency", "rows"),
    [
        (2, 0, "00 10 20 30"),  # at once: each row is the first of its own chunk
        (2, 1, "-- 00 01 11 12 21 22"),  # skips what was played since, and no more
        (2, 2, "-- -- 00 01 02 12 13 14 22"),
        # longer than the rows that are left
        (2, 4, "-- -- -- -- 00 01 02 -- -- 12 13 14 -- -- 22"),
        (0, 1, "-- 00 01 02 -- 10 11 12 -- 20"),
    ],
)
def test_an_answer_of_the_simulator_takes_as_long_as_it_is_told(
    prefetch_at: int, latency: int, rows: str
) -> None:
    """A benchmark has to show what a slow policy costs; the world stood for none of its time."""
    expected = [None if text == "--" else (float(text[0]), float(text[1])) for text in rows.split()]
    for slow in (False, True):  # the answer's real time has no part in it
        policy = Policy(6)

        def fetch(observation: Any, policy: Policy = policy, slow: bool = slow) -> Any:
            future = policy.fetch(observation)
            if not slow:
                policy.answer()
            return future

        player = ChunkPlayer(
            fetch, prefetch_at=prefetch_at, keep=3, wait_s=1e-9, latency_steps=latency
        )
        played, hits = [], []
        for step in range(len(expected)):
            if slow and policy.futures and not policy.futures[-1].done() and latency:
                policy.answer()
            row = player.next_row(step)
            played.append(None if row is None else row.row)
            if row is not None and row.prefetched is not None:
                hits.append(row.prefetched)
        if latency or not slow:  # an answer that takes no step cannot come a step later
            assert played == expected
            assert set(hits) == {0 < latency <= prefetch_at or not latency}


def test_a_robot_that_stood_still_misses_no_row() -> None:
    """The chunk still begins where the robot is: rows are skipped for steps that were played."""
    policy = Policy(6)
    player = ChunkPlayer(policy.fetch, prefetch_at=2, keep=3)
    assert rows_of(player, policy, 6, delay=9) == [(0, 0), (0, 1), (0, 2), (1, 2), (1, 3), (1, 4)]


def standing(prefetch_at: int, delay: int) -> int:
    """Return the steps without a row between the first and the thirtieth row."""
    policy = Policy(12)
    player = ChunkPlayer(policy.fetch, prefetch_at=prefetch_at, keep=6)
    stood, waited = 0, 0
    while player.played < 30:
        if policy.futures and not policy.futures[-1].done():
            waited += 1
            if waited > delay:
                policy.answer()
                waited = 0
        stood += player.next_row(None if not player.wants_observation() else "o") is None
    return stood - (delay + 1)  # those before the first row


def test_a_prefetch_that_covers_the_latency_never_stands_still() -> None:
    assert [standing(prefetch_at, delay=2) for prefetch_at in (0, 1, 2, 3, 5)] == [12, 8, 4, 0, 0]


def test_what_the_chunks_say_about_the_steps_to_come() -> None:
    """Left-over rows begin with those that are played before the new chunk, `delay` of them."""
    policy = Policy(6)
    player = ChunkPlayer(policy.fetch, prefetch_at=2, keep=3)
    assert (player.left_over(10), player.delay) == ([], 0)
    rows_of(player, policy, 1)
    assert player.delay == 2
    assert player.left_over(10) == [(0, 1), (0, 2), (0, 3), (0, 4), (0, 5)]
    assert player.left_over(3) == [(0, 1), (0, 2), (0, 3)]


def test_without_prefetch_the_observation_is_taken_after_the_last_row() -> None:
    policy = Policy(3)
    player = ChunkPlayer(policy.fetch)
    assert player.wants_observation()
    assert player.next_row("o0") is None
    assert not player.wants_observation()
    policy.answer()
    assert [player.next_row(None) for _ in range(3)] == [
        Played(0, (0.0, float(i)), first=i == 0) for i in range(3)
    ]
    assert player.wants_observation()
    assert player.next_row("o3") is None
    assert policy.asked == ["o0", "o3"]


def test_waiting_for_a_chunk_is_bounded() -> None:
    player = ChunkPlayer(Policy(3).fetch, wait_s=0.01)
    assert player.next_row("o") is None


def test_an_empty_chunk_and_a_missing_observation_are_refused() -> None:
    policy = Policy(0)
    player = ChunkPlayer(policy.fetch)
    player.next_row("o")
    policy.answer()
    with pytest.raises(ModelError, match="chunk of 0"):
        player.next_row(None)
    with pytest.raises(ModelError, match="no observation"):
        player.next_row(None)


def test_closing_forgets_what_is_under_way() -> None:
    policy = Policy(2)
    player = ChunkPlayer(policy.fetch, prefetch_at=1)
    player.next_row("o")
    policy.answer()
    player.next_row(None)
    player.close()
    assert player.wants_observation()


def test_a_request_that_was_cancelled_or_timed_out_is_a_typed_error() -> None:
    policy = Policy(1)
    player = ChunkPlayer(policy.fetch)
    player.next_row("o")
    policy.futures[-1].set_exception(TimeoutError())
    with pytest.raises(ModelError, match="in time"):
        player.next_row(None)
    player.next_row("o")
    policy.futures[-1].cancel()
    with pytest.raises(ModelError, match="in time"):
        player.next_row(None)


class AnsweredAsOneLooks(concurrent.futures.Future[list[Row]]):
    """Not there yet when one stops waiting, there when one looks whether it is."""

    def done(self) -> bool:
        if not super().done():
            self.set_result([(1.0,)])
        return super().done()


@pytest.mark.parametrize("wait_s", [0.0, 0.001])
def test_an_answer_that_comes_right_behind_the_wait_is_no_timeout(wait_s: float) -> None:
    """Regression: an answer between the end of the wait and the check counted as the policy's
    time-out."""
    player = ChunkPlayer(lambda _: AnsweredAsOneLooks(), wait_s=wait_s)
    assert player.next_row("o") == Played(0, (1.0,), first=True)
