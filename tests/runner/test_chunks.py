"""Chunks play in order, nothing twice, nothing dropped, at any chunk size and any prefetch."""

import concurrent.futures
from typing import Any

import pytest

from runner.skills.chunks import ChunkPlayer
from schemas.errors import Evicted, ModelError

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


@pytest.mark.parametrize("size", [1, 2, 3, 5, 16])
@pytest.mark.parametrize("prefetch_at", [0, 1, 5, 20])
@pytest.mark.parametrize("delay", [0, 1, 4])
def test_every_row_is_played_once_and_in_order(size: int, prefetch_at: int, delay: int) -> None:
    policy = Policy(size)
    player = ChunkPlayer(policy.fetch, prefetch_at=prefetch_at)
    played: list[Row] = []
    waited = 0
    for step in range(400):
        row = player.next_row(step)
        if row is not None:
            played.append(row[1])
            assert row[0] == int(row[1][0])
        if policy.futures and not policy.futures[-1].done():
            waited += 1
            if waited > delay:
                policy.answer()
                waited = 0
        if len(played) >= 50:
            break
    assert played[:50] == [(float(i // size), float(i % size)) for i in range(50)]
    assert player.played == len(played)


def test_without_prefetch_the_observation_is_taken_after_the_last_row() -> None:
    policy = Policy(3)
    player = ChunkPlayer(policy.fetch)
    assert player.wants_observation()
    assert player.next_row("o0") is None
    assert not player.wants_observation()
    policy.answer()
    assert [player.next_row(None) for _ in range(3)] == [(0, (0.0, float(i))) for i in range(3)]
    assert player.wants_observation()
    assert player.next_row("o3") is None
    assert policy.asked == ["o0", "o3"]


def test_waiting_for_a_chunk_is_bounded() -> None:
    player = ChunkPlayer(Policy(3).fetch, wait_s=0.01)
    assert player.next_row("o") is None


def test_a_chunk_that_is_there_is_played_at_once_when_waiting_is_allowed() -> None:
    def fetch(_: Any) -> Any:
        future: concurrent.futures.Future[list[Row]] = concurrent.futures.Future()
        future.set_result([(1.0,)])
        return future

    assert ChunkPlayer(fetch, wait_s=1.0).next_row("o") == (0, (1.0,))


@pytest.mark.parametrize("error", [Evicted("gone"), ModelError("no")])
def test_what_the_fetch_raises_reaches_the_skill(error: Exception) -> None:
    policy = Policy(1)
    player = ChunkPlayer(policy.fetch)
    player.next_row("o")
    policy.futures[-1].set_exception(error)
    with pytest.raises(type(error)):
        player.next_row(None)


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
