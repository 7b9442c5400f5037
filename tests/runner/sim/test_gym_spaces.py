"""Spaces as rows of numbers: there and back is the same, whatever is sent is in the space, and what
is no row of numbers is refused.
"""

from typing import Any

import pytest

pytestmark = pytest.mark.heavy

np = pytest.importorskip("numpy")
spaces = pytest.importorskip("gymnasium.spaces")

from hypothesis import given, settings  # noqa: E402
from hypothesis import strategies as st  # noqa: E402

from vram_arbiter.runner.sim.gym_spaces import (  # noqa: E402
    CHOICES_MAX,
    ActionRow,
    NoNumbers,
    leaves,
)

FLOATS = ("float16", "float32", "float64")
INTEGERS = ("int8", "uint8", "int32", "int64")
AXES = st.sampled_from(((1,), (3,), (1, 2), (2, 3)))
SHAPES = st.one_of(st.just(()), AXES)
FINITE = st.floats(allow_nan=False, allow_infinity=False)


@st.composite
def boxes(draw: Any) -> Any:
    dtype = draw(st.sampled_from((*FLOATS, *INTEGERS, "bool")))
    shape = draw(SHAPES)
    if dtype == "bool":
        return spaces.Box(0, 1, shape, np.bool_)
    near = 100 if dtype in ("int8", "uint8") else 1000
    low = draw(st.integers(0 if dtype == "uint8" else -near, near))
    high = draw(st.integers(low, near))
    if dtype in FLOATS:
        unlimited = draw(st.sampled_from(((), (0,), (1,), (0, 1))))
        return spaces.Box(
            np.full(shape, -np.inf if 0 in unlimited else low, dtype),
            np.full(shape, np.inf if 1 in unlimited else high + 0.5, dtype),
            dtype=dtype,
        )
    return spaces.Box(low, high, shape, dtype)


@st.composite
def multi_discretes(draw: Any) -> Any:
    shape = draw(AXES)
    size = int(np.prod(shape))
    nvec = draw(st.lists(st.integers(1, 300), min_size=size, max_size=size))
    start = draw(st.lists(st.integers(-50, 50), min_size=size, max_size=size))
    return spaces.MultiDiscrete(np.reshape(nvec, shape), start=np.reshape(start, shape))


PARTS = st.one_of(
    boxes(),
    multi_discretes(),
    st.builds(
        lambda n, start: spaces.Discrete(n, start=start),
        st.integers(1, 10**9),
        st.integers(-99, 99),
    ),
    st.one_of(st.integers(1, 4), AXES).map(spaces.MultiBinary),
)
KEYS = st.text("abc", min_size=1, max_size=3)
SPACES = st.recursive(
    PARTS,
    lambda inner: st.one_of(
        st.dictionaries(KEYS, inner, min_size=1, max_size=3).map(spaces.Dict),
        st.lists(inner, min_size=1, max_size=3).map(spaces.Tuple),
    ),
    max_leaves=5,
)


def same(one: Any, other: Any) -> bool:
    """Also in their kinds: what an environment gets is what it would have sampled itself."""
    if isinstance(one, dict):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if isinstance(
        other, np.ndarray
    ):  # of a Box without axes gymnasium samples a plain number of its dtype
        return bool(
            one.dtype == other.dtype and np.shape(one) == other.shape and (one == other).all()
        )
    return int(one) == other and isinstance(other, int)  # of a Discrete


@settings(max_examples=150, deadline=None)
@given(space=SPACES, seed=st.integers(0, 2**31 - 1))
def test_every_action_of_a_space_goes_there_and_back(space: Any, seed: int) -> None:
    row = ActionRow(space)
    space.seed(seed)
    element = space.sample()
    numbers = row.row_of(element)
    assert len(numbers) == len(row.names) == len(set(row.names)) == len(row.low) == len(row.high)
    assert all(
        low <= number <= high for low, number, high in zip(row.low, numbers, row.high, strict=True)
    )
    assert same(element, row.element(numbers))


@settings(max_examples=150, deadline=None)
@given(space=SPACES, data=st.data())
def test_every_row_of_finite_numbers_is_an_action_of_the_space(space: Any, data: Any) -> None:
    row = ActionRow(space)
    size = len(row.names)
    near = st.one_of(FINITE, st.floats(-1.2, 1.2), st.sampled_from((-1.0, 0.0, 0.5, 1.0)))
    numbers = data.draw(st.lists(near, min_size=size, max_size=size))
    element = row.element(numbers)
    assert space.contains(element)
    assert same(element, row.element(row.row_of(element)))


def test_numbers_are_called_by_the_paths_of_their_parts() -> None:
    space = spaces.Dict(
        {
            "gripper": spaces.Discrete(3),
            "arm": spaces.Box(-2.0, 2.0, (2, 2)),
            "more": spaces.Tuple((spaces.MultiBinary(2), spaces.MultiDiscrete([4]))),
        }
    )
    row = ActionRow(space)
    assert row.names == (
        *("arm.0", "arm.1", "arm.2", "arm.3"),  # gymnasium sorts the keys
        *("gripper", "more.0.0", "more.0.1", "more.1"),
    )
    assert row.low == (*[-2.0] * 4, -1.0, 0.0, 0.0, -1.0)
    assert row.high == (*[2.0] * 4, 1.0, 1.0, 1.0, 1.0)
    assert ActionRow(spaces.Discrete(2)).names == ("action",)
    assert ActionRow(spaces.MultiBinary(2)).names == ("action.0", "action.1")


def test_choices_are_equal_parts_and_bits_are_set_from_the_half_on() -> None:
    row = ActionRow(
        spaces.Tuple(
            (
                spaces.Discrete(4, start=10),
                spaces.MultiDiscrete([2, 3], start=[0, 5]),
                spaces.MultiBinary(2),
            )
        )
    )
    for numbers, chosen, axes, bits in (
        ((-1.0, -1.0, -1.0, 0.0, 0.49), 10, [0, 5], [0, 0]),
        ((-0.5, -0.01, -0.34, 0.5, 0.51), 11, [0, 5], [1, 1]),
        ((0.49, 0.0, 0.0, 1.0, 0.0), 12, [1, 6], [1, 0]),
        ((1.0, 1.0, 1.0, 1.0, 1.0), 13, [1, 7], [1, 1]),
    ):
        element = row.element(numbers)
        assert (element[0], element[1].tolist(), element[2].tolist()) == (chosen, axes, bits)


def test_the_ends_of_whole_numbers_are_kept() -> None:
    ends = np.iinfo(np.int64)
    box = spaces.Box(ends.min, ends.max, (2,), np.int64)
    assert ActionRow(box).element([-1e300, 1e300]).tolist() == [ends.min, ends.max]
    assert ActionRow(spaces.Box(0, 255, (2,), np.uint8)).element([2.5, 254.6]).tolist() == [2, 255]


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (spaces.Text(3), "it is Text.*a text is not a number"),
        (spaces.Dict(a=spaces.Discrete(2), b=spaces.Tuple((spaces.Text(3),))), "b.0 is Text"),
        (spaces.Sequence(spaces.Discrete(2)), "longer one time than another"),
        (spaces.Graph(spaces.Box(0, 1, (1,)), None), "a graph has more nodes"),
        (spaces.OneOf((spaces.Discrete(2), spaces.Box(0, 1, (2,)))), "which of its alternatives"),
        (spaces.Dict({}), "nothing in it to decide"),
        (spaces.Box(0, 1, (0,)), "nothing in it to decide"),
        (spaces.Discrete(CHOICES_MAX + 1), "cannot be told apart"),
        (spaces.Discrete(3, start=2**60), "cannot be told apart"),
        (spaces.Dict({"a": spaces.Box(0, 1, (2,)), "a.0": spaces.Discrete(2)}), "the same name"),
    ],
)
def test_what_is_no_row_of_numbers_says_why(space: Any, said: str) -> None:
    with pytest.raises(NoNumbers, match=said):
        ActionRow(space)


@pytest.mark.parametrize(
    "wrong",
    [
        {"arm": [0.0, 0.0]},
        {"arm": [0.0, 0.0], "grip": 1, "more": 0},
        {"arm": [0.0], "grip": 1},
        {"arm": ["left", 0.0], "grip": 1},
        {"arm": [float("nan"), 0.0], "grip": 1},
        {"arm": [0.0, 0.0], "grip": 2},
        {"arm": [0.0, 0.0], "grip": 0.5},
        {"arm": [0.0, 0.0], "grip": None},
        [0.0, 0.0, 1],
        None,
    ],
)
def test_what_is_no_action_of_the_space_is_no_row(wrong: Any) -> None:
    with pytest.raises(NoNumbers):
        ActionRow(spaces.Dict(arm=spaces.Box(-1, 1, (2,)), grip=spaces.Discrete(2))).row_of(wrong)


def test_a_tuple_has_as_many_parts_as_it_has() -> None:
    row = ActionRow(spaces.Tuple((spaces.Discrete(2), spaces.MultiBinary(1))))
    assert row.row_of([1, [0]]) == [0.5, 0.0]
    for wrong in ([1], [1, [0], 0], {0: 1, 1: [0]}, "ab", [1, [2]]):
        with pytest.raises(NoNumbers):
            row.row_of(wrong)


def test_an_observations_numbers_are_its_own() -> None:
    space = spaces.Dict(
        a=spaces.Tuple((spaces.Discrete(5, start=3), spaces.MultiBinary(2))), b=spaces.Text(3)
    )
    discrete, bits, text = leaves(space)
    seen = {"a": (np.int64(7), np.array([1, 0], np.int8)), "b": "xyz"}
    assert (discrete.numbers(seen), bits.numbers(seen)) == ([7.0], [1.0, 0.0])
    for wrong in (
        {"a": (7,)},
        {"b": "x"},
        {"a": (7, np.array([1], np.int8))},
        {"a": (7, ["x", "y"])},
        None,
    ):
        with pytest.raises(NoNumbers):
            bits.numbers(wrong)
    with pytest.raises(NoNumbers):
        text.numbers(seen)
