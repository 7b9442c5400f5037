"""The table of states, and the story that an illegal move carries."""

import pytest

from vram_arbiter.arbiter.core.model.lease import (
    AWAY,
    STORY_MAX,
    TRANSITIONS,
    IllegalTransition,
    Lease,
    LeaseState,
    Request,
)
from vram_arbiter.schemas.ids import ClientId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


def lease(priority: int = 50, residue_bytes: int = 7) -> Lease:
    spec = LeaseSpec(
        consumer="det", model_id="m", footprint=Footprint(10, 10, residue_bytes), priority=priority
    )
    request = Request("n", 100.0, 1, 10, 10)
    return Lease(LeaseId("L1-1"), spec, ProcessKey(1, 1), ClientId("c"), request)


def test_every_state_is_in_the_table_and_terminal_ones_lead_nowhere() -> None:
    assert set(TRANSITIONS) == set(LeaseState)
    assert {state for state, following in TRANSITIONS.items() if not following} == {
        LeaseState.RELEASED,
        LeaseState.EXPIRED,
        LeaseState.LOST,
        LeaseState.DENIED,
        LeaseState.CANCELLED,
    }


def test_only_who_is_away_waits_again_and_nothing_leads_out_of_expired() -> None:
    back = {state for state, following in TRANSITIONS.items() if LeaseState.QUEUED in following}
    assert back == AWAY
    assert not TRANSITIONS[LeaseState.EXPIRED]


def test_a_long_life_is_told_by_its_last_steps() -> None:
    one = lease()
    for turn in range(40):
        for to in (LeaseState.LOADING, LeaseState.HELD, LeaseState.VERIFYING, LeaseState.PARKED):
            one.move(to, float(turn), f"turn {turn}")
    assert len(one.story) == STORY_MAX
    assert one.told().endswith("39.000 parked (turn 39)")


def test_a_legal_life_is_told() -> None:
    one = lease()
    assert one.told() == "new"
    one.move(LeaseState.LOADING, 101.0, "granted")
    one.move(LeaseState.HELD, 102.5, "ready")
    assert one.since == 102.5
    assert one.told() == "101.000 loading (granted); 102.500 held (ready)"


@pytest.mark.parametrize("to", sorted(set(LeaseState) - TRANSITIONS[LeaseState.QUEUED]))
def test_an_illegal_move_changes_nothing_and_carries_the_story(to: LeaseState) -> None:
    one = lease()
    with pytest.raises(
        IllegalTransition, match=rf"L1-1: queued → {to} is not legal; story: new"
    ) as caught:
        one.move(to, 101.0, "no")
    assert caught.value.lease_id == one.id
    assert (one.state, one.since, one.story) == (LeaseState.QUEUED, 100.0, [])


def test_priority_grows_by_a_point_for_every_five_seconds_waited() -> None:
    one = lease(priority=50)
    assert [one.priority_at(at, 5.0) for at in (99.0, 100.0, 104.9, 105.0, 120.0)] == [
        50,
        50,
        50,
        51,
        54,
    ]


def test_a_process_that_exits_keeps_nothing() -> None:
    one = lease(residue_bytes=7)
    assert one.residue_bytes == 7
    one.departure.exiting = True
    assert one.residue_bytes == 0
