"""Pickles read as data: what lerobot sends is read, and nothing else is, nor costs more."""

import os
import pickle
import resource
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import BadRequest, LimitExceeded
from vram_arbiter.sidecars.doors.pickles import OPCODES_MAX, Array, Record, read

pytestmark = pytest.mark.heavy

NAMES = {"tests.Thing": Record}
HEAD = b"\x80\x04"


def plain(value: Any) -> Any:
    return value.numbers.tolist() if isinstance(value, Array) else value


@pytest.mark.parametrize("protocol", [3, 4, 5])
def test_numbers_arrays_and_tensors_are_read(protocol: int) -> None:
    import numpy as np
    import torch

    base = np.arange(24.0).reshape(2, 3, 4)
    sent = {
        "int": 3, "long": 2**40, "float": 1.5, "text": "ü", "none": None, "flag": True,
        "pair": (1, 2), "tuple": (1, 2, 3, 4), "nested": {"list": [1, 2]},
        "scalar": np.float32(2.5), "array": base, "fortran": np.asfortranarray(base),
        "strided": base[:, ::2], "pixels": np.arange(12, dtype=np.uint8).reshape(2, 2, 3),
        "empty": np.zeros((0, 3)), "flags": np.array([True, False]),
    }  # fmt: skip
    found = read(pickle.dumps(sent, protocol), NAMES)
    assert {name: plain(value) for name, value in found.items()} == {
        name: value.tolist() if isinstance(value, np.ndarray) else value
        for name, value in sent.items()
    }
    row = torch.arange(6.0)
    tensors = [row, row.reshape(2, 3).T, row[2:4], row.long(), row.bool(), row.half()]
    found = read(pickle.dumps(tensors, protocol), NAMES)
    assert [plain(one) for one in found] == [one.tolist() for one in tensors]


class Runs:
    """Its pickle runs a command when `pickle.loads` reads it."""

    def __init__(self, function: Any, *arguments: Any) -> None:
        self.call = function, arguments

    def __reduce__(self) -> Any:
        return self.call


def test_what_would_run_is_refused_and_does_not(tmp_path: Path) -> None:
    mark = tmp_path / "ran"
    hostile = [Runs(os.system, f"touch {mark}"), Runs(eval, f"open({str(mark)!r}, 'w')")]
    hostile += [Runs(getattr, "text", "upper"), {"observation": Runs(os.mkdir, str(mark))}]
    for one in hostile:
        for protocol in (2, 4, 5):
            with pytest.raises(BadRequest, match=r"names '.*', which is not of this protocol"):
                read(pickle.dumps(one, protocol), NAMES)
    assert not mark.exists()


HOSTILE = {
    "a slot of a huge memo": HEAD + b"Nr\xff\xff\xff\x7fN.",
    "a byte array of 2**62": HEAD + b"\x96" + (2**62).to_bytes(8, "little") + b".",
    "bytes of 4 GiB": HEAD + b"B\xff\xff\xff\xff.",
    "an integer of a mebibyte": HEAD + b"\x8b" + MIB.to_bytes(4, "little") + bytes(MIB) + b".",
    "digits without end": b"I" + b"9" * MIB + b"\n.",
    "a text without end": b"S'" + b"a" * MIB,
    "an extension": HEAD + b"\x82\x01.",
    "a reference": b"Psomething\n.",
    "an instance": b"(ios\nsystem\n.",
    "state of a name": HEAD + b"ctests\nThing\n}b.",
    "a call of a text": HEAD + b"\x8c\x01x)R.",
    "a call without arguments": HEAD + b"ctests\nThing\nNR.",
    "a class where a list stands": HEAD + b"ctests\nThing\nNa.",
    "marks alone": HEAD + b"((((.",
    "an empty stack": HEAD + b"0.",
    "a key that cannot be one": HEAD + b"}]Ns.",
    "an object type": HEAD + b"cnumpy\ndtype\n\x8c\x02O8\x85R.",
    "fields": HEAD + b"cnumpy\ndtype\n\x8c\x05V1000\x85R.",
    "nothing": b"",
    "no end": HEAD + b"N",
    "a second value": HEAD + b"NN.",
}  # fmt: skip


@pytest.mark.parametrize("data", HOSTILE.values(), ids=HOSTILE.keys())
def test_what_is_malformed_is_refused(data: bytes) -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(BadRequest):
        read(data, NAMES)
    grown_kib = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before
    assert grown_kib < 64 * 1024, "nothing is allocated for what only its header has"


DEEP = {
    "lists": b"]" * (OPCODES_MAX - 1),
    "without end": b"]" * MIB,
    "tuples": b")" + b"\x85" * (OPCODES_MAX - 3) + b".",
    "tuples as a key": b"})" + b"\x85" * (OPCODES_MAX - 6) + b"Ns.",
    "itself": b"]\x94h\x00a" + b"h\x00a" * 3000 + b".",
}


@pytest.mark.parametrize("data", DEEP.values(), ids=DEEP.keys())
def test_depth_and_number_of_values_are_bounded(data: bytes) -> None:
    try:
        read(HEAD + data, NAMES)
    except (BadRequest, LimitExceeded):
        pass  # the deepest that is read does no harm either


def array_of(shape: tuple[int, ...], data: bytes, dtype: str = "u1") -> bytes:
    """A pickle of an array whose header and bytes may disagree."""
    parts = [HEAD, b"cnumpy.core.multiarray\n_reconstruct\n", b"(N)Nt", b"R("]
    parts += [pickle.dumps(1, 2)[2:-1], pickle.dumps(shape, 2)[2:-1]]
    parts += [b"cnumpy\ndtype\n", pickle.dumps((dtype,), 2)[2:-1], b"R\x89"]
    return b"".join([*parts, b"B", len(data).to_bytes(4, "little"), data, b"tb."])


def test_an_array_has_as_many_bytes_as_it_says() -> None:
    assert plain(read(array_of((2, 2), b"abcd"), NAMES)) == [[97, 98], [99, 100]]
    for shape in ((10**6, 10**6), (2**62, 4), (-1,), (3,), (1,) * 40):
        with pytest.raises(BadRequest):
            read(array_of(shape, b"abcd"), NAMES)


def tensor_of(shape: tuple[int, ...], strides: tuple[int, ...], offset: int = 0) -> bytes:
    import torch

    whole = pickle.dumps(torch.arange(4.0), 4)
    storage = whole[whole.index(b"\x8c\rtorch.storage") : whole.index(b"K\x00K\x04")]
    numbers = b"".join(pickle.dumps(one, 2)[2:-1] for one in (offset, shape, strides, False))
    return b"".join([HEAD, b"ctorch._utils\n_rebuild_tensor_v2\n(", storage, numbers, b"NtR."])


def test_a_tensor_lies_within_its_storage() -> None:
    """A stride of 0 makes a terabyte of four bytes."""
    assert plain(read(tensor_of((2, 2), (2, 1)), NAMES)) == [[0.0, 1.0], [2.0, 3.0]]
    for shape, strides, offset in (
        ((10**6, 10**6), (0, 0), 0), ((5,), (0,), 0), ((5,), (1,), 0), ((2,), (1,), 3),
        ((2,), (-1,), 0), ((1,), (1,), -1), ((2,), (2**40,), 0), ((-1,), (1,), 0),
    ):  # fmt: skip
        with pytest.raises(BadRequest):
            read(tensor_of(shape, strides, offset), NAMES)


@settings(max_examples=300, deadline=None)
@given(st.integers(0, 2**16), st.binary(min_size=0, max_size=3), st.integers(0, 2**16))
def test_damaged_pickles_are_refused(at: int, put: bytes, end: int) -> None:
    """Whatever a byte is changed to: read, or refused with a typed error."""
    import numpy as np

    whole = pickle.dumps({"a": np.arange(3.0), "b": [np.float32(1), (1, 2)], "c": "x"}, 4)
    at %= len(whole)
    damaged = whole[:at] + put + whole[at + len(put) : at + 1 + end % len(whole)]
    try:
        read(damaged, NAMES)
    except (BadRequest, LimitExceeded):
        pass


def test_nested_tensors_share_the_number_of_instructions() -> None:
    import torch

    several = pickle.dumps([torch.zeros(1) for _ in range(200)], 4)
    with pytest.raises(LimitExceeded, match=f"more than {OPCODES_MAX} instructions"):
        read(several, NAMES)
    assert len(several) < MIB
