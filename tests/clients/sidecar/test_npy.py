"""Arrays on the wire."""

import re
import subprocess
import sys
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.errors import BadRequest


def test_plain_values_pass_and_numpy_is_not_imported_for_them() -> None:
    code = (
        "import sys; from vram_arbiter.clients.sidecar import npy; v = {'a': [1, 'x', None, "
        "(2.0,)], 'b': b'y'}; "
        "assert npy.unpack(npy.pack(v)) == {'a': [1, 'x', None, [2.0]], 'b': b'y'}; assert 'numpy' "
        "not in sys.modules"
    )
    subprocess.run([sys.executable, "-c", code], check=True)


@pytest.mark.heavy
def test_arrays_and_scalars() -> None:
    import numpy

    image = numpy.zeros((4, 5, 3), dtype=numpy.uint8)
    packed = npy.pack({"image": image, "n": numpy.float32(1.5), "nested": [{"m": numpy.ones(2)}]})
    assert set(packed["image"]) == {npy.MARK, npy.BYTES}
    assert packed["n"] == 1.5
    found = npy.unpack(packed)
    assert found["image"].shape == (4, 5, 3)
    assert found["image"].dtype == numpy.uint8
    assert found["nested"][0]["m"].tolist() == [1.0, 1.0]


@pytest.mark.heavy
@pytest.mark.parametrize("payload", [b"", b"not npy", "text", None])
def test_what_is_no_array_is_refused(payload: object) -> None:
    with pytest.raises(BadRequest):
        npy.unpack({npy.MARK: True, npy.BYTES: payload})


@pytest.mark.heavy
def test_pickles_are_neither_written_nor_read() -> None:
    import io

    import numpy

    evil = numpy.array([object()], dtype=object)
    with pytest.raises(ValueError):
        npy.pack(evil)
    stream = io.BytesIO()
    numpy.save(stream, evil, allow_pickle=True)
    with pytest.raises(BadRequest):
        npy.unpack({npy.MARK: True, npy.BYTES: stream.getvalue()})


def npy_bytes(array: Any, **options: Any) -> bytes:
    import io

    import numpy

    stream = io.BytesIO()
    numpy.save(stream, array, **options)
    return stream.getvalue()


def head(text: str, version: tuple[int, int] = (1, 0)) -> bytes:
    size = len(text).to_bytes(2 if version == (1, 0) else 4, "little")
    return b"\x93NUMPY" + bytes(version) + size + text.encode()


@pytest.mark.heavy
def test_only_arrays_of_numbers_whose_bytes_are_there() -> None:
    import io

    import numpy

    archive = io.BytesIO()
    numpy.savez(archive, a=numpy.zeros(3))
    header = "{'descr': '<f8', 'fortran_order': False, 'shape': (%s), }"
    refused = {
        "not an array in .npy format": [
            archive.getvalue(), head("(" * 500), head("1" * 5000), head("{'descr': '<f8'}"),
            head(header % "3.5,"), head("os.system('x')"), head(header % "1,", (3, 0)), head("\n "),
            head("{'descr': [], 'fortran_order': 1, 'shape': 2}"),
        ],
        "not of numbers": [
            npy_bytes(numpy.array(["text"])), npy_bytes(numpy.zeros(2, "c16")),
            npy_bytes(numpy.zeros(2, "M8[s]")),
            npy_bytes(numpy.zeros(2, [("a", "f4")])), npy_bytes(numpy.zeros(2, "V8")),
        ],
        "by its header has": [
            head(header % "1000000000000,"), npy_bytes(numpy.zeros(3))[:-1],
            npy_bytes(numpy.zeros(3)) + b"x",
            head(header % ("9" * 400 + ",")),
        ],
        "an array of shape": [head(header % "-1,") + bytes(8),
        head(header % ("1," * 9)) + bytes(8)],
    }  # fmt: skip
    for told, payloads in refused.items():
        for payload in payloads:
            with pytest.raises(BadRequest, match=re.escape(told)):
                npy.unpack({npy.MARK: True, npy.BYTES: payload})


@pytest.mark.heavy
def test_arrays_of_msgpack_numpy_are_read_and_its_pickles_are_not() -> None:
    import numpy

    array = {b"nd": True, b"type": "<f4", b"kind": b"", b"shape": [2, 1], b"data": bytes(8)}
    found = npy.unpack({"a": array, "b": {key.decode(): array[key] for key in array}})
    for one in found.values():
        assert (one.dtype, one.shape, one.flags.writeable) == (numpy.float32, (2, 1), True)
    assert npy.unpack({b"nd": False, b"type": "<i2", b"data": b"\x07\x00"}) == 7
    assert npy.unpack({"nd": "a name"}) == {"nd": "a name"}
    for changes in (
        {b"kind": b"O"}, {b"kind": b"V", b"type": [["a", "<f4"]]}, {b"type": "|O"},
        {b"type": "<c8"},
        {b"type": "no type"}, {b"type": "(2,)<f4"}, {b"type": "<f4" * 9}, {b"shape": [3, 1]},
        {b"shape": [-2, -1]}, {b"shape": [2.0, 1]}, {b"shape": 2}, {b"shape": [1] * 9 + [2]},
        {b"data": "text"}, {b"data": bytes(7)}, {b"nd": False},
    ):  # fmt: skip
        with pytest.raises(BadRequest):
            npy.unpack({"a": {**array, **changes}})
    with pytest.raises(BadRequest, match="more than 256 arrays"):
        npy.unpack([array] * (npy.ARRAYS_MAX + 1))


@pytest.mark.heavy
def test_a_message_has_a_bounded_number_of_arrays() -> None:
    import numpy

    one = {npy.MARK: True, npy.BYTES: npy_bytes(numpy.zeros(1))}
    assert len(npy.unpack([one] * npy.ARRAYS_MAX)) == npy.ARRAYS_MAX
    with pytest.raises(BadRequest, match="more than 256 arrays"):
        npy.unpack({"nested": [one] * (npy.ARRAYS_MAX + 1)})


@pytest.mark.heavy
@settings(max_examples=200, deadline=None)
@given(
    dtype=st.sampled_from(["<f4", ">f8", "<i2", "|u1", "|b1", "<f2"]),
    shape=st.lists(st.integers(0, 5), max_size=4),
    fortran=st.booleans(),
    seed=st.integers(0, 9),
)
def test_every_array_of_numbers_comes_back(
    dtype: str, shape: list[int], fortran: bool, seed: int
) -> None:
    import numpy

    numbers = numpy.random.default_rng(seed).integers(0, 100, shape).astype(dtype)
    array = numpy.asfortranarray(numbers) if fortran else numbers
    found = npy.unpack(npy.pack(array))
    assert (found == array).all()
    assert (found.dtype, found.shape) == (array.dtype, array.shape)
    assert found.flags.writeable


@pytest.mark.heavy
@settings(max_examples=300, deadline=None)
@given(at=st.integers(0, 140), inserted=st.binary(min_size=1, max_size=8))
def test_damaged_arrays_are_read_or_refused(at: int, inserted: bytes) -> None:
    import numpy

    whole = npy_bytes(numpy.arange(4.0))
    damaged = whole[:at] + inserted + whole[at + len(inserted) :]
    try:
        found = npy.unpack({npy.MARK: True, npy.BYTES: damaged})
    except BadRequest:
        return
    assert isinstance(found, numpy.ndarray)
    assert found.nbytes <= len(damaged)


@pytest.mark.heavy
def test_arrays_of_openpi_are_read() -> None:
    import msgpack
    import numpy
    from openpi_client import msgpack_numpy

    sent = {
        "image": numpy.arange(24, dtype=numpy.uint8).reshape(2, 4, 3),
        "state": [numpy.float32(1.5), numpy.arange(3.0)],
        "prompt": "grab",
    }
    found = npy.unpack(msgpack.unpackb(msgpack_numpy.packb(sent)))
    numpy.testing.assert_array_equal(found["image"], sent["image"])
    assert (found["state"][0], found["state"][1].tolist()) == (1.5, [0.0, 1.0, 2.0])
    for kind in ("|O", "|V8", "<c8"):
        array = {b"__ndarray__": True, b"data": bytes(8), b"dtype": kind, b"shape": [1]}
        with pytest.raises(BadRequest, match="not of numbers"):
            npy.unpack({"state": array})
