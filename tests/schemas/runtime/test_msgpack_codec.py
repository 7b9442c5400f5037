"""A message is counted before it is built: what it may cost is bounded by its limits, not by its
bytes."""

from typing import Any

import msgpack
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import BadFrame, MessageTooLarge
from vram_arbiter.schemas.runtime.msgpack_codec import (
    UnpackLimits,
    count_values,
    leading_id,
    unpack_map,
)

LIMITS = UnpackLimits(message_max_bytes=MIB, values_max=100, keys_max=20, items_max=30)


class Counted(bytes):
    """Bytes that count how often one of them is looked at."""

    looks = 0

    def __getitem__(self, key: Any) -> Any:
        self.looks += 1
        return super().__getitem__(key)


def values_in(value: Any) -> int:
    if isinstance(value, dict):
        return 1 + sum(values_in(key) + values_in(held) for key, held in value.items())
    if isinstance(value, list):
        return 1 + sum(values_in(held) for held in value)
    return 1


_VALUES = st.recursive(
    st.none() | st.booleans() | st.integers(-(1 << 63),
    (1 << 64) - 1) | st.floats() | st.text() | st.binary()
    | st.builds(msgpack.ExtType, st.integers(0, 127), st.binary(max_size=20)),
    lambda inner: st.lists(inner, max_size=20) | st.dictionaries(st.text(max_size=8), inner,
    max_size=20),
    max_leaves=12,
)  # fmt: skip


@settings(deadline=None, max_examples=60)
@given(_VALUES)
def test_the_count_is_that_of_the_decoded_value(value: Any) -> None:
    """A count that reads a header otherwise than the decoder would let a bomb through, or refuse an
    honest message."""
    assert count_values(msgpack.packb(value), 1_000_000) == values_in(value)


@pytest.mark.parametrize("size", [0, 1, 2, 4, 8, 15, 16, 17, 31, 32, 255, 256, 65_535, 65_536])
def test_every_form_of_a_length_is_read(size: int) -> None:
    held = (
        [0] * size,
        {str(n): 0 for n in range(size)},
        "x" * size,
        b"x" * size,
        msgpack.ExtType(5, b"x" * size),
    )
    for value in held:
        assert count_values(msgpack.packb([value, None]), 1_000_000) == 2 + values_in(value)


@settings(deadline=None)
@given(st.binary(max_size=300))
def test_any_bytes_are_a_map_or_a_typed_error(payload: bytes) -> None:
    try:
        found = unpack_map(payload, LIMITS)
    except (BadFrame, MessageTooLarge):
        return
    assert values_in(found) <= len(payload)


@pytest.mark.parametrize(
    "payload",
    [
        b"\xdd\x00\x0f\xff\xf0" + b"\x80" * (MIB - 16),  # one list of a million maps
        b"\x9f" * (MIB - 1),  # lists in lists
        b"\x91" * (MIB - 1),
        (b"\xdc\x00\x1e" + b"\xc0" * 29)
        * 32_000,  # each list is short, and the last item of the one before
        b"\xde\xff\xff" + b"\xa1k\xc0" * 300_000,
    ],
)
def test_a_bomb_is_refused_after_few_looks(payload: bytes) -> None:
    """1 MiB of empty lists costs as many values as it has bytes when it is built first and counted
    afterwards."""
    counted = Counted(payload)
    assert count_values(counted, LIMITS.values_max) > LIMITS.values_max
    assert counted.looks <= 2 * LIMITS.values_max
    with pytest.raises(MessageTooLarge) as raised:
        unpack_map(payload, LIMITS)
    assert raised.value.details["limit_values"] == 100


@pytest.mark.parametrize(
    ("value", "says"),
    [
        ({f"k{n}": 0 for n in range(21)}, "max_map_len"),
        ({"k": [0] * 31}, "max_array_len"),
        ({"k": msgpack.ExtType(1, b"abcd")}, "max_ext_len"),
        ({"k": msgpack.Timestamp(1, 1)}, "max_ext_len"),
        ({1: 2}, "key"),
        ([1], "list"),
    ],
)
def test_what_is_not_a_message_is_named(value: Any, says: str) -> None:
    with pytest.raises(BadFrame, match=says):
        unpack_map(msgpack.packb(value), LIMITS)


def test_large_bytes_are_skipped_not_walked() -> None:
    """A picture of many bytes is one value."""
    payload = Counted(msgpack.packb({"op": "infer", "image": b"\x80" * (MIB // 2)}))
    assert count_values(payload, 100) == 5
    assert payload.looks < 20
    assert len(unpack_map(payload, LIMITS)["image"]) == MIB // 2


@pytest.mark.parametrize(
    ("payload", "found"),
    [
        (msgpack.packb({"id": 2**53, "op": "goal", "params": [0] * 10_000}), 2**53),
        (msgpack.packb({"id": 7} | {f"k{n}": 0 for n in range(100_000)})[:40], 7),
        (msgpack.packb({"op": "goal", "id": 7}), None),
        (msgpack.packb({"id": "7"}), None),
        (msgpack.packb({"id": True}), None),
        (msgpack.packb({"id": "x" * MIB}), None),
        (msgpack.packb({}), None),
        (msgpack.packb([1]), None),
        (b"\x81\xa2\xff\xff\x01", None),
        (b"\x9f" * 100, None),
        (b"\xdf\xff", None),
        (b"", None),
    ],
)
def test_the_id_that_a_request_begins_with_is_read_from_its_first_bytes(
    payload: bytes, found: int | None
) -> None:
    assert leading_id(payload) == found
