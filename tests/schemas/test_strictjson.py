"""JSON that Python would take and a robot must not."""

import json
import math

import msgpack
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.schemas import strictjson

JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.floats()
    | st.integers(-(1 << 70), 1 << 70)
    | st.text(st.characters(), max_size=4),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=4), inner, max_size=3)
    ),
    max_leaves=10,
)


@pytest.mark.parametrize(
    "text",
    [
        "NaN", "[Infinity]", '{"a": -Infinity}', "1e999", '{"a": 1, "a": 2}', "[" * 66 + "]" * 66,
        "[" * 100_000, '"\\ud800"',
        '{"\\udfff": 1}', "18446744073709551616", "[-9223372036854775809]", "", "{", "x", "1 2",
        '"' + "x" * 70_000 + '"',
    ],
)  # fmt: skip
def test_refused(text: str) -> None:
    with pytest.raises(ValueError):
        strictjson.loads(text)


@pytest.mark.parametrize(
    "text",
    ["null", "[]", '{"a": [1, 2.5, "\\ud83d\\ude00"]}', "[" * 64 + "]" * 64, "9223372036854775807"],
)
def test_read_as_usual(text: str) -> None:
    assert strictjson.loads(text) == json.loads(text)


@given(JSON)
def test_whatever_is_let_through_goes_over_a_wire(value: object) -> None:
    """Regression: a number of 70 bits would have ended an episode with a traceback: msgpack carries
    64."""
    try:
        read = strictjson.loads(json.dumps(value))
    except ValueError:
        return
    assert msgpack.unpackb(msgpack.packb(read), strict_map_key=False) == read


@given(st.binary(max_size=40) | st.text(max_size=40))
def test_anything_else_is_a_value_error(text: str | bytes) -> None:
    try:
        value = strictjson.loads(text)
    except ValueError:
        return
    assert not (isinstance(value, float) and not math.isfinite(value))
