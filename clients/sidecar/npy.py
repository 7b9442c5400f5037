"""Arrays on the sidecar wire: `{"__ndarray_class__": true, "as_npy": <bytes of numpy's .npy
format>}`, never pickle.

Of that format only arrays of numbers are taken, and nothing is allocated before the header agrees
with the bytes behind it. numpy is imported inside the functions: the base install has none.
"""

import io
import math
import sys
from typing import Any

from vram_arbiter.schemas.errors import BadRequest

MARK = "__ndarray_class__"
BYTES = "as_npy"
ARRAYS_MAX = 256  # of a message: each costs some 30 µs, and a robot sends one per sensor
DIMENSIONS_MAX = 8
HEADER_MAX_BYTES = 1024
NUMBERS = "biuf"  # kinds of numpy's: truth values, integers, floats
_HINT = "send numpy.save output of an array of numbers"


def pack(value: Any) -> Any:
    """A copy of nested maps and lists with every array (and torch-free numpy scalar) made plain."""
    numpy = sys.modules.get("numpy")  # unless it is loaded there can be no array
    if isinstance(value, dict):
        return {key: pack(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [pack(item) for item in value]
    if numpy is not None and isinstance(value, numpy.ndarray):
        stream = io.BytesIO()
        numpy.save(stream, value, allow_pickle=False)
        return {MARK: True, BYTES: stream.getvalue()}
    if numpy is not None and isinstance(value, numpy.generic):
        return value.item()
    return value


def unpack(value: Any) -> Any:
    """The inverse of `pack`. Raises BadRequest for bytes that are not an array of numbers, and for
    more than `ARRAYS_MAX` arrays."""
    found = 0

    def plain(value: Any) -> Any:
        nonlocal found
        if isinstance(value, dict):
            if value.get(MARK) is True and BYTES in value:
                found += 1
                if found > ARRAYS_MAX:
                    raise BadRequest(
                        f"more than {ARRAYS_MAX} arrays in a message", hint="send fewer"
                    )
                return _array(value[BYTES])
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    return plain(value)


def _array(payload: object) -> Any:
    import numpy

    if not isinstance(payload, bytes):
        raise BadRequest(f"{BYTES} holds {type(payload).__name__}, not bytes", hint=_HINT)
    npy: Any = numpy.lib.format  # its stubs lack max_header_size
    stream = io.BytesIO(payload)
    try:
        version = npy.read_magic(stream)
        readers = {(1, 0): npy.read_array_header_1_0, (2, 0): npy.read_array_header_2_0}
        if version not in readers:
            raise ValueError(f"version {version} of the format")
        shape, fortran, dtype = readers[version](stream, max_header_size=HEADER_MAX_BYTES)
    except Exception as error:  # noqa: BLE001  numpy evaluates the header, which fails in many ways
        raise BadRequest(f"not an array in .npy format: {error}", hint=_HINT) from None
    if dtype.kind not in NUMBERS or dtype.shape:
        raise BadRequest(f"an array of {dtype}, not of numbers", hint=_HINT)
    if len(shape) > DIMENSIONS_MAX or any(side < 0 for side in shape):
        raise BadRequest(
            f"an array of shape {str(shape)[:80]}",
            hint=f"send at most {DIMENSIONS_MAX} dimensions of 0 or more",
        )
    needed, there = math.prod(shape) * dtype.itemsize, len(payload) - stream.tell()
    if needed != there:
        raise BadRequest(f"an array of {needed} bytes by its header has {there}", hint=_HINT)
    flat = (
        numpy.frombuffer(payload, dtype, offset=stream.tell()) if needed else numpy.empty(0, dtype)
    )
    return flat.reshape(shape, order="F" if fortran else "C").copy()
