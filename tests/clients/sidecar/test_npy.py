"""Arrays on the wire."""

import subprocess
import sys

import pytest

from clients.sidecar import npy
from schemas.errors import BadRequest


def test_plain_values_pass_and_numpy_is_not_imported_for_them() -> None:
    code = (
        "import sys; from clients.sidecar import npy; v = {'a': [1, 'x', None, (2.0,)], 'b': b'y'}; "
        "assert npy.unpack(npy.pack(v)) == {'a': [1, 'x', None, [2.0]], 'b': b'y'}; assert 'numpy' not in sys.modules"
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
