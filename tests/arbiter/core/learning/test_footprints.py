"""What was measured of a model, and what of it counts for the next request."""

import pytest

from vram_arbiter.arbiter.core.learning import HISTORY_MAX, MODELS_MAX, OOM_LOADS, Footprints
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec


@pytest.mark.parametrize(
    ("declared", "learned", "expected"),
    [
        (Footprint(5, 4, 1), {}, (5, 4)),
        (Footprint(5, 4, 6), {}, (6, 6)),
        (Footprint(5, 4, 1), {"load_peak": [3], "steady": [2], "residue": [7]}, (5, 4)),
        (Footprint(5, 4, 1), {"load_peak": [7]}, (7, 4)),
        (Footprint(5, 4, 1), {"steady": [7]}, (7, 7)),
        (Footprint(5, 4, 1), {"load_peak": [9], "steady": [9]}, (8, 8)),
        (Footprint(9, 9, 9), {"load_peak": [10], "steady": [10]}, (9, 9)),
    ],
)
def test_a_request_is_charged_the_larger_of_what_is_declared_and_what_was_learned(
    declared: Footprint, learned: dict[str, list[int]], expected: tuple[int, int]
) -> None:
    """What was learned never asks for more than the largest GPU has."""
    prints = Footprints(8)
    prints.restore({"det m": learned, "det other": {"load_peak": [8], "steady": [8]}})
    assert prints.expected_bytes(LeaseSpec("det", "m", declared)) == expected


def test_few_measurements_count_by_their_maximum_and_many_by_their_95th_percentile() -> None:
    prints = Footprints(1 << 60)
    assert prints.p95_bytes("det m", "load_peak") == 0, "never seen"
    for count in (5, 7, 6):
        prints.measured("det m", "load_peak", count)
    assert (prints.p95_bytes("det m", "load_peak"), prints.p95_bytes("det m", "steady")) == (7, 0)
    prints = Footprints(1 << 60)
    for count in [1000, *range(1, 20)]:
        prints.measured("det m", "steady", count)
    assert prints.p95_bytes("det m", "steady") == 19, "one outlier in twenty no longer counts"
    assert prints.p95_bytes("vlm m", "steady") == 0, "another consumer's model is another model"


def test_only_the_last_measurements_count() -> None:
    prints = Footprints(1 << 60)
    for _ in range(HISTORY_MAX):
        prints.measured("det m", "residue", 9)
    for _ in range(HISTORY_MAX):
        prints.measured("det m", "residue", 4)
    assert prints.p95_bytes("det m", "residue") == 4


def test_an_out_of_memory_outweighs_many_loads_before_and_is_forgotten_in_the_end() -> None:
    prints = Footprints(1 << 60)
    for _ in range(HISTORY_MAX):
        prints.measured("det m", "load_peak", 5)
    prints.out_of_memory("det m", 9)
    prints.out_of_memory("det m", 8)
    for _ in range(OOM_LOADS - 1):
        prints.measured("det m", "load_peak", 5)
        prints.measured("det m", "steady", 3)
    assert prints.p95_bytes("det m", "load_peak") == 9
    prints.measured("det m", "load_peak", 5)
    assert prints.p95_bytes("det m", "load_peak") == 5, "so many loads did with less"


def test_what_is_kept_says_the_same_after_a_restart() -> None:
    prints, again = Footprints(1 << 60), Footprints(1 << 60)
    prints.measured("det m", "load_peak", 5)
    prints.measured("det m", "steady", 4)
    prints.out_of_memory("det m", 9)
    prints.out_of_memory("vlm m", 7)
    assert prints.kept() == {
        "det m": {"load_peak": [5], "steady": [4], "oom": [9, OOM_LOADS]},
        "vlm m": {"oom": [7, OOM_LOADS]},
    }
    again.restore(prints.kept())
    assert again.kept() == prints.kept()
    assert again.p95_bytes("det m", "load_peak") == 9
    assert again.p95_bytes("det m", "steady") == 4


def test_what_is_not_understood_is_left_out() -> None:
    prints = Footprints(1 << 60)
    prints.restore(
        {
            "a": {"load_peak": 5, "steady": ["x", -1, 0, 3], "oom": [1], "more": [1]},
            "b": {"oom": [5, 999]},
        }
    )
    assert prints.kept() == {"a": {"steady": [3]}, "b": {"oom": [5, OOM_LOADS]}}


def test_models_that_nobody_loads_any_more_are_forgotten() -> None:
    prints = Footprints(1 << 60)
    prints.measured("old m", "steady", 1)
    for number in range(MODELS_MAX - 1):
        prints.measured(f"m{number}", "steady", 1)
    prints.measured("old m", "steady", 1)
    prints.measured("one more", "steady", 1)
    assert "old m" in prints.kept()
    assert "m0" not in prints.kept()
    assert len(prints.kept()) == MODELS_MAX
