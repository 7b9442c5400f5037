"""Cursor, queues and the saved state: nothing lost, nothing twice, everything bounded."""

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.feed import Cursor
from vram_arbiter.clients.observer.hooks.events import Delivery
from vram_arbiter.clients.observer.hooks.queues import Runner, Saved, StateFile
from vram_arbiter.schemas.config.observer import Hook
from vram_arbiter.schemas.errors import ActionFailed, AlreadyRunning, ConfigError
from vram_arbiter.schemas.wire.replies import HistoryReply


def reply(numbering: str, *seqs: int, last: int = 0) -> HistoryReply:
    events = tuple({"seq": seq, "kind": "granted"} for seq in seqs)
    return HistoryReply(events, last or max(seqs, default=0), "", numbering)


def seqs(cursor: Cursor, answer: HistoryReply) -> list[int] | None:
    events = cursor.take(answer)
    return None if events is None else [event["seq"] for event in events]


# -- cursor
def test_the_first_start_begins_with_the_events_from_then_on() -> None:
    cursor = Cursor({})
    assert seqs(cursor, reply("n", 1, 2, 3)) is None
    assert cursor.after == 3
    assert seqs(cursor, reply("n", 4, 2007)) == [4, 2007]
    assert seqs(cursor, reply("n", 2007)) == [], "an answer to an older question"
    assert Cursor(cursor.read).after == 2007


def test_a_history_that_began_again_is_new_and_one_that_returns_goes_on() -> None:
    cursor = Cursor({"a": 50})
    assert seqs(cursor, reply("b", 1, 2)) is None
    assert cursor.after == 0, "every event of a new history is new"
    assert seqs(cursor, reply("b", 1, 2)) == [1, 2]
    assert seqs(cursor, reply("a", 1, 60)) is None
    assert cursor.after == 50
    assert Cursor(cursor.read).numbering == "a", "the newest is last"
    for name in "cdefghij":
        cursor.take(reply(name))
    assert len(cursor.read) == 8


# -- queues
def hook(name: str = "h", **fields: Any) -> Hook:
    return Hook.model_validate({"name": name, "on": "granted", "command": ["true"], **fields})


def event(seq: int) -> dict[str, object]:
    return {"seq": seq, "kind": "granted", "consumer": "c"}


class Acts:
    """Deliveries as they were performed; those of the rule `slow` wait for `go`."""

    def __init__(self) -> None:
        self.done: list[tuple[str, object, int]] = []
        self.began = asyncio.Event()
        self.go = asyncio.Event()

    async def __call__(self, hook: Hook, delivery: Delivery) -> None:
        self.began.set()
        if hook.name == "slow":
            await self.go.wait()
        if delivery.event["seq"] == 13:
            raise ActionFailed("13")
        self.done.append((hook.name, delivery.event["seq"], delivery.dropped))


def with_runner(
    hooks: Sequence[Hook],
    test: Callable[[Runner, Acts], Awaitable[None]],
    pending: Sequence[Delivery] = (),
) -> Runner:
    async def work() -> Runner:
        acts = Acts()
        runner = Runner(hooks, acts, pending)
        running = asyncio.create_task(runner.run())
        async with asyncio.timeout(PATIENCE_S):
            await test(runner, acts)
            running.cancel()
            with pytest.raises(asyncio.CancelledError):
                await running
        return runner

    return asyncio.run(work())


async def settled(runner: Runner, left: int = 0) -> None:
    while len(runner.pending) > left:
        await asyncio.sleep(0)


def test_a_slow_rule_delays_no_other_and_drops_its_oldest() -> None:
    async def test(runner: Runner, acts: Acts) -> None:
        runner.put([event(1)], "n")
        await acts.began.wait()
        for seq in range(2, 8):
            runner.put([event(seq)], "n")
        await settled(runner, left=3)
        assert [seq for name, seq, _ in acts.done if name == "quick"] == [1, 2, 3, 4, 5, 6, 7]
        acts.go.set()
        await settled(runner)
        slow = [(seq, dropped) for name, seq, dropped in acts.done if name == "slow"]
        assert slow == [(1, 0), (6, 4), (7, 0)], "2 to 5 were dropped, and 6 says so"

    with_runner([hook("slow", queue_max=2), hook("quick")], test)


def test_a_failed_delivery_is_over() -> None:
    async def test(runner: Runner, acts: Acts) -> None:
        runner.put([event(13)], "n")
        runner.put([event(14)], "n")
        await settled(runner)
        assert [seq for _, seq, _ in acts.done] == [14]

    with_runner([hook()], test)


def test_what_a_stop_cut_short_is_pending_and_repeated() -> None:
    async def stop(runner: Runner, acts: Acts) -> None:
        runner.put([event(1)], "n")
        runner.put([event(2)], "n")
        await acts.began.wait()

    async def finish(runner: Runner, acts: Acts) -> None:
        acts.go.set()
        await settled(runner)
        assert [seq for _, seq, _ in acts.done] == [1, 2]

    slow = hook("slow")
    pending = with_runner([slow], stop).pending
    assert [one.key for one in pending] == ["n-1-slow", "n-2-slow"]
    with_runner([slow], finish, pending)


# -- state
def test_the_state_comes_back_and_has_one_owner(tmp_path: Path) -> None:
    saved = Saved({"a": 3, "b": 9}, (Delivery("h", "granted", event(9), "b-9-h", 1),))
    state = StateFile(tmp_path / "own/hooks.json")
    assert state.load() == Saved()
    state.save(saved)
    with pytest.raises(AlreadyRunning, match="vram-observer"):
        StateFile(tmp_path / "own/hooks.json")
    again = state.load()
    assert (dict(again.read), tuple(again.pending)) == (saved.read, saved.pending)
    assert list(again.read) == ["a", "b"]


def test_a_damaged_state_is_refused_with_what_to_do(tmp_path: Path) -> None:
    path = tmp_path / "hooks.json"
    path.write_text('{"read": {')
    with pytest.raises(ConfigError, match="remove it"):
        StateFile(path).load()
