"""Words for every code that the engine can say. No type checker sees into the templates."""

from dataclasses import replace
from itertools import product

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.arbiter.core.model import refusals as r
from vram_arbiter.arbiter.rpc import explained, words
from vram_arbiter.schemas.ids import GpuId, LeaseId
from vram_arbiter.schemas.wire.codes import Block, Order, Wait, Why
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.explained import (
    Because,
    Blocker,
    Condition,
    Explanation,
    FootprintView,
    NextAction,
    Step,
)
from vram_arbiter.schemas.wire.notes import About, VerifiedNote
from vram_arbiter.schemas.wire.views import BlockView

REFUSALS = sorted(words._ERRORS.keys() - {r.TimedOut}, key=str)
FOOTPRINT = FootprintView({"load_peak": 3, "steady": 2, "residue": 1}, {}, None)


@pytest.mark.parametrize("kind", REFUSALS, ids=lambda kind: kind.__name__)
@settings(max_examples=8)
@given(data=st.data())
def test_every_refusal_says_what_is_wrong_and_what_to_do(
    kind: type[Refusal], data: st.DataObject
) -> None:
    """Names with braces are values, never templates."""
    refusal = data.draw(st.from_type(kind))
    if isinstance(refusal, r.BadTargetState) and refusal.silent_s is None:
        refusal = replace(refusal, silent_s=1.0)
    error = words.error_view(refusal)
    assert error.message
    assert error.hint


def test_every_refusal_of_the_engine_has_words() -> None:
    """Those of an operator's action on a lease that is over are the words of that lease's end."""
    engine = {
        one for one in vars(r).values() if isinstance(one, type) and one.__module__ == r.__name__
    }
    refusals = {one for one in engine if issubclass(one, Refusal) and not one.__subclasses__()}
    assert refusals - {r.TargetOver} == words._ERRORS.keys()


@settings(max_examples=40)
@given(told=st.builds(Explanation, footprint=st.just(FOOTPRINT)))
def test_every_explanation_has_words(told: Explanation) -> None:
    text = explained.worded(told).text
    assert text.startswith(told.consumer)
    assert text in words.error_view(r.TimedOut("det", 1.0, told)).message


def test_every_code_has_words() -> None:
    for code in Condition:
        assert explained.condition(Blocker("L1-1", "det", 1, "held", 0, code, by="{g}", pid=7)), (
            code
        )
    for block in Block:
        assert explained.block(BlockView(block, ("{det}",))), block
    for action, because in product(NextAction, Because):
        step = Step(action, "{det}", "L1-1", 1.0, because, waiter="{w}")
        assert explained.step_words(step), step
    assert explained.WAIT.keys() == set(Wait)


@pytest.mark.parametrize(
    ("problem", "evictable", "hint"),
    [
        (r.Impractical.HOLDER_LIVES, True, "evict it instead"),
        (r.Impractical.HOLDER_LIVES, False, "end its program: it is pinned"),
        (r.Impractical.NOT_PINNED, True, "nothing to undo"),
        (
            r.Impractical.NOT_PINNED,
            False,
            "its holder asked never to be evicted, and it alone can change that",
        ),
    ],
)
def test_a_refused_action_says_what_can_be_done_with_this_lease(
    problem: r.Impractical, evictable: bool, hint: str
) -> None:
    error = words.error_view(r.BadTargetState("L1-1", "held", problem, evictable, silent_s=1.0))
    assert error.hint == hint


def test_an_action_on_a_lease_that_is_over_names_its_end() -> None:
    """What the lease's own program would be told is no help to an operator."""
    over = words.error_view(r.TargetOver.of(r.Lost("L1-1", Why.PROCESS_DIED, 102)))
    assert (over.code, over.message) == ("lease_lost", "L1-1: process 102 died")
    assert over.hint == "it is over; see `vramctl history`"


def test_an_operators_order_is_quoted_where_it_ended_a_lease() -> None:
    order = Order("ops (uid 0, pid 7)", "hangs since noon")
    given_up = words.error_view(r.Expired("L1-1", 600.0, Why.GIVEN_UP, order))
    assert given_up.message == "L1-1 was given up by ops (uid 0, pid 7): hangs since noon"


def test_a_process_without_a_lease_is_named_by_its_pid() -> None:
    """Its verdict named a consumer `1234@567890`, which was offered as a filter of the history."""
    verdict = VerifiedNote("verified", True, 1.0, None, None, 0, ())
    told = words.event(Note(verdict, About(None, "1234@567890", GpuId("GPU-0"))))
    assert told["pid"] == 1234
    assert "consumer" not in told
    named = words.event(Note(verdict, About(LeaseId("L1-1"), "1234@567890", GpuId("GPU-0"))))
    assert named["consumer"] == "1234@567890"
