"""The explorer itself: a tiny world to its end, a seeded defect by its shortest story, and which
worlds count as the same."""

import json
from dataclasses import asdict

import pytest

from tests.explore.cloning import Freezer, thaw
from tests.explore.fingerprint import canonical, fingerprint
from tests.explore.scenarios import BIG, HELD, TALKS, kind
from tests.explore.search import Search, play
from tests.explore.world import (
    CAPACITY_BYTES,
    OVERHEAD_BYTES,
    STEP_S,
    Broken,
    Scenario,
    story,
)
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Asked, Event, MemorySampled, ProbeFailed
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.wire.requests import Release, UseBegin, UseEnd

ONE = Scenario("one", (BIG,))
TWO = Scenario("two", (BIG, BIG), acquires=2)
APART = Scenario("apart", (kind("left", GIB, gpu="0"), kind("right", GIB, gpu="1")), gpus=2)
TALK = Scenario("talk", (TALKS, TALKS), talks=True, faults={"drop": 1})


class Credulous(Arbiter):
    """A seeded defect: bytes count as free when their holder says so."""

    def handle(self, event: Event, now: float) -> list[Effect]:
        effects = super().handle(event, now)
        if isinstance(event, Asked) and isinstance(event.request, Release):
            for gpu in self.inspect().gpus.values():
                for part in (16, 8):  # the second reading confirms the first
                    at = now + STEP_S / part
                    empty = MemorySampled(gpu.info.id, at, OVERHEAD_BYTES, CAPACITY_BYTES, ())
                    effects += super().handle(empty, at)
        return effects


# -- the search
def test_a_tiny_world_is_explored_to_its_end() -> None:
    report = Search(ONE).run(60.0)
    assert not report.error
    assert report.complete
    assert report.unproven == 0
    assert json.loads(json.dumps(asdict(report)))["verbs"] == report.verbs
    assert {"acquire", "load", "ready", "use", "end", "leave", "free", "read"} <= set(report.verbs)


def test_a_defect_is_found_with_its_shortest_story() -> None:
    """The driver still has the bytes of the first client when the second one is granted them."""
    scenario = Scenario("credulous", (BIG, BIG), lags=True, engine=Credulous)
    report = Search(scenario).run(60.0)
    assert report.error
    expected = "acquire a, load a, ready a, leave a, free a, acquire b"
    assert report.story == story(expected)
    assert "are granted or occupied" in report.error
    assert "play(SCENARIOS['credulous'], [('acquire', 'a')" in str(report)
    with pytest.raises(Broken, match="are granted or occupied"):
        play(scenario, report.story)


class Blind(Arbiter):
    """A seeded defect: no reading counts, so that nothing is granted."""

    def handle(self, event: Event, now: float) -> list[Effect]:
        if isinstance(event, MemorySampled):
            event = ProbeFailed(event.gpu, event.taken_at, "unread")
        return super().handle(event, now)


def test_a_waiter_that_no_path_serves_is_found() -> None:
    report = Search(Scenario("blind", (BIG,), engine=Blind)).run(60.0)
    assert report.error
    assert report.story == story("acquire a")
    assert report.error == "a client waits for ever"


class Forgetful(Arbiter):
    """A seeded defect: a use is answered and forgotten."""

    def handle(self, event: Event, now: float) -> list[Effect]:
        effects = super().handle(event, now)
        if isinstance(event, Asked) and isinstance(begun := event.request, UseBegin):
            end = UseEnd(begun.lease_id, begun.token, begun.use_id)
            super().handle(Asked(event.client, event.id, end), now)
        return effects


def test_a_use_begun_ahead_of_its_answer_is_known_to_both_in_the_end() -> None:
    scenario = Scenario("forgetful", (TALKS,), after=HELD, talks=True, engine=Forgetful)
    report = Search(scenario).run(60.0)
    assert report.story in (story("use a, send a, hear a"), story("ahead a, send a, hear a"))
    assert "of {} uses" in report.error
    with pytest.raises(Broken, match="believes"):
        play(scenario, story("ahead a, send a, hear a"))


def test_a_deadline_that_comes_again_and_again_hides_no_other_one() -> None:
    """The graph knew a client's ping alone of two deadlines, never the reading that grants, and
    said that no path serves the other client."""
    after = (
        "acquire a, send a, hear a, load a, ready a, send a, drop a, sleep, "
        "acquire b, send b, hear b, sleep, sleep"
    )
    late = Scenario("late", (TALKS, TALKS), after=after, talks=True)
    report = Search(late).run(60.0)
    assert not report.error, report
    assert report.complete
    assert report.served
    assert report.unproven == 0


# -- copies
@pytest.mark.parametrize("scenario", [TWO, TALK], ids=lambda one: one.name)
def test_a_copy_is_the_same_world_and_another(scenario: Scenario) -> None:
    world = play(scenario, story("acquire a, acquire b"))
    freezer, before = Freezer(), canonical(world)
    frozen = [freezer.freeze(world) for _ in range(3)]  # each with more words than the one before
    assert [canonical(thaw(one)) for one in frozen] == [before] * 3
    copy = thaw(frozen[0])
    while copy.clients["a"].up or copy.clients["a"].down:
        copy.act(next(action for action in copy.actions() if action[0] in ("send", "hear")))
    copy.act(next(action for action in copy.actions() if action[0] == "load"))
    assert canonical(copy) != before
    assert canonical(world) == canonical(thaw(frozen[0])) == before


# -- which worlds are the same
@pytest.mark.parametrize(
    ("scenario", "one", "other"),
    [
        pytest.param(TWO, "acquire a", "acquire b", id="clients that are alike"),
        pytest.param(
            TWO, "acquire a, acquire b, load a", "acquire b, acquire a, load b", id="one holds"
        ),
        pytest.param(APART, "acquire a, acquire b", "acquire b, acquire a", id="two GPUs"),
        pytest.param(
            APART,
            "acquire a, acquire b, load a, ready a, load b",
            "acquire b, load b, acquire a, load a, ready a",
            id="two GPUs, three events",
        ),
        pytest.param(TALK, "acquire a, acquire b", "acquire b, acquire a", id="two messages"),
        pytest.param(
            TALK,
            "acquire a, acquire b, send a, hear a, send b",
            "acquire b, acquire a, send a, send b, hear a",
            id="a message sent, another heard",
        ),
    ],
)
def test_the_order_of_independent_events_makes_no_difference(
    scenario: Scenario, one: str, other: str
) -> None:
    assert fingerprint(play(scenario, story(one))) == fingerprint(play(scenario, story(other)))


@pytest.mark.parametrize(
    ("scenario", "one", "other"),
    [
        pytest.param(TWO, "", "acquire a", id="a grant"),
        pytest.param(TWO, "acquire a", "acquire a, acquire b", id="a waiter"),
        pytest.param(TWO, "acquire a", "acquire a, load a", id="bytes"),
        pytest.param(
            TWO,
            "acquire a, load a, ready a",
            "acquire a, load a, ready a, use a",
            id="a use",
        ),
        pytest.param(
            TWO,
            "acquire a, tick, load a, read GPU-0",
            "acquire a, load a, tick, read GPU-0",
            id="what a reading shows",
        ),
        pytest.param(
            TWO,
            "tick, acquire a, read GPU-0",
            "acquire a, tick, read GPU-0",
            id="what a reading can have seen",
        ),
        pytest.param(TALK, "acquire a", "acquire a, send a", id="a message under way"),
        pytest.param(TALK, "acquire a, send a", "acquire a, send a, hear a", id="one heard"),
        pytest.param(TALK, "acquire a", "drop a, acquire a", id="a connection"),
        pytest.param(
            TALK,
            f"{HELD}, use a, drop a",
            f"{HELD}, leave a, drop a",
            id="what is sent again",
        ),
    ],
)
def test_worlds_that_a_client_can_tell_apart_are_two(
    scenario: Scenario, one: str, other: str
) -> None:
    assert fingerprint(play(scenario, story(one))) != fingerprint(play(scenario, story(other)))
