"""A small fleet on paper: what two random choices among equals are for."""

import pytest

from tests.sim.fleet_run import BOARDS, STORIES, Story, first, model_first, play_story, two_choices

BOXES = 60


@pytest.mark.parametrize("story", STORIES, ids=lambda story: story.name)
def test_two_choices_spread_what_one_view_would_heap(story: Story) -> None:
    spread, heaped = (play_story(story, choose, BOXES, seed=1) for choose in (two_choices, first))
    assert spread.most <= heaped.most
    assert spread.waited <= heaped.waited
    assert spread.unplaced == 0


def test_a_hot_model_waits_less_where_its_boxes_must_have_room() -> None:
    (hot,) = (story for story in STORIES if story.name == "hot model")
    waited = [
        play_story(hot, choose, BOXES, seed=1).waited for choose in (two_choices, model_first)
    ]
    assert waited[0] < waited[1]


def test_boards_that_are_all_dead_leave_every_box_unknown() -> None:
    dark = Story("dark", dead=BOARDS)
    assert play_story(dark, two_choices, BOXES, seed=1).unplaced == 2 * BOXES
