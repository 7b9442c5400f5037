"""What several looks say together."""

import math

import pytest

from vram_arbiter.reasoner.search_map import Places


def look(base_pose: list[float] | None, *things: tuple[float, float, float]) -> dict[str, object]:
    seen = [{"point_base_m": [x, y, 0.2], "score": score} for x, y, score in things]
    data: dict[str, object] = {"point_base_m": seen[0]["point_base_m"], "seen": seen}
    return data if base_pose is None else data | {"base_pose": base_pose}


def test_scores_of_one_place_add_up_over_looks_from_different_places() -> None:
    """Regression: the last look alone decided, and the demo's seed 2 drove the robot to a similar
    object every time."""
    places = Places()
    places.add(look([0.0, 0.0, 0.0], (1.0, 0.0, 0.6), (1.0, 0.5, 0.7)))
    # the first again, seen from the side
    places.add(look([1.0, -0.5, math.pi / 2], (0.51, 0.02, 0.5)))
    best = places.best()
    assert best.score == pytest.approx(1.1)
    assert (best.x, best.y) == pytest.approx((0.98, 0.01)), "told from the nearest look"
    assert len(places.known) == 2
    back = places.from_base(best)
    assert back == pytest.approx((0.51, 0.02, 0.2))


def test_two_things_of_one_look_are_two_places_however_near() -> None:
    places = Places()
    for _ in range(2):
        places.add(look([0.0, 0.0, 0.0], (0.5, 0.0, 0.6), (0.5, 0.04, 0.5)))
    assert [round(place.score, 2) for place in places.known] == [1.2, 1.0]


def test_a_look_from_farther_does_not_move_a_place() -> None:
    places = Places()
    places.add(look([0.5, 0.0, 0.0], (0.5, 0.0, 0.6)))
    places.add(look([0.0, 0.0, 0.0], (1.03, 0.0, 0.6)))
    assert [(place.x, round(place.score, 2)) for place in places.known] == [(1.0, 1.2)]


def test_what_says_no_more_than_a_point_is_a_place_of_its_own_look() -> None:
    places = Places()
    assert places.best() is None
    for x in (0.4, 0.3):
        places.add({"point_base_m": [x, 0.1, 0.2]})
    best = places.best()
    assert best is not None
    assert not places.joined
    assert places.from_base(best) == (0.3, 0.1, 0.2)
