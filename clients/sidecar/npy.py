"""Arrays on the sidecar wire: `{"__ndarray_class__": true, "as_npy": <bytes of numpy's .npy
format>}`, never pickle. Those of the packages msgpack-numpy and openpi-client are read as well.

Of that format only arrays of numbers are taken, and nothing is allocated before the header agrees
with the bytes behind it. numpy is imported inside the functions: the base install has none.
"""

import io
import math
import sys
from collections.abc import Sequence
from typing import Any

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.plain import Message

MARK = "__ndarray_class__"
BYTES = "as_npy"
ARRAYS_MAX = 256  # of a message: each costs some 30 µs, and a robot sends one per sensor
DIMENSIONS_MAX = 8
HEADER_MAX_BYTES = 1024
DTYPE_MAX_CHARS = 16
PLAIN_KINDS = (None, "", b"")  # of msgpack-numpy's arrays; "O" is pickled, "V" has fields
NUMBERS = "biuf"  # kinds of numpy's: truth values, integers, floats
_ND = b"nd"
_OPENPI, _OPENPI_SCALAR = b"__ndarray__", b"__npgeneric__"
_KEYS = (_ND, b"type", b"kind", b"shape", b"data")
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

    def count() -> None:
        nonlocal found
        found += 1
        if found > ARRAYS_MAX:
            raise BadRequest(f"more than {ARRAYS_MAX} arrays in a message", hint="send fewer")

    def plain(value: Any) -> Any:
        if isinstance(value, dict):
            if value.get(MARK) is True and BYTES in value:
                count()
                return _array(value[BYTES])
            if _ND in value or "nd" in value:
                named = {key.decode() if key in _KEYS else key: value[key] for key in value}
                if isinstance(named["nd"], bool) and "data" in named:
                    count()
                    return _msgpack_numpy(named)
            if value.get(_OPENPI) is True:
                count()
                return _openpi(value)
            if value.get(_OPENPI_SCALAR) is True:
                return plain(value.get(b"data"))
            return {key: plain(item) for key, item in value.items()}
        if isinstance(value, list | tuple):
            return [plain(item) for item in value]
        return value

    return plain(value)


def _msgpack_numpy(value: Message) -> Any:
    """An array or a scalar of the package msgpack-numpy, which newer servers of the field use:
    `{"nd": …, "type": "<f4", "kind": "", "shape": […], "data": bytes}`. Its arrays of objects are
    pickled, and refused."""
    import numpy

    wanted, shape, data = value.get("type"), value.get("shape", []), value.get("data")
    kind, scalar = value.get("kind"), not value["nd"]
    if not isinstance(wanted, str) or len(wanted) > DTYPE_MAX_CHARS or kind not in PLAIN_KINDS:
        raise BadRequest("an array that is not of numbers", hint=_HINT)
    if not isinstance(data, bytes) or not isinstance(shape, list):
        raise BadRequest("an array without bytes and shape", hint=_HINT)
    try:
        dtype: Any = numpy.dtype(wanted)
    except (TypeError, ValueError, SyntaxError) as error:
        raise BadRequest(f"an array of type {wanted!r}: {error}", hint=_HINT) from None
    numbers = flat(data, dtype, [] if scalar else shape)
    return numbers[0].item() if scalar else numbers.reshape(shape).copy()


def _openpi(value: dict[Any, Any]) -> Any:
    """An array of openpi-client: `{b"__ndarray__": True, b"dtype", b"shape", b"data"}`, which is
    msgpack-numpy's without a kind."""
    found = {name: value.get(name.encode()) for name in ("dtype", "shape", "data")}
    return _msgpack_numpy({"nd": True, "type": found.pop("dtype"), **found})


def as_openpi(numbers: Any) -> dict[bytes, Any]:
    """An array in openpi's form (its `msgpack_numpy.py`)."""
    return {
        _OPENPI: True,
        b"data": numbers.tobytes(),
        b"dtype": numbers.dtype.str,
        b"shape": numbers.shape,
    }


def flat(data: bytes, dtype: Any, shape: Sequence[Any], offset: int = 0) -> Any:
    """The numbers behind `offset`, in a row; nothing is copied. Raises BadRequest where type, shape
    and bytes disagree."""
    import numpy

    if dtype.kind not in NUMBERS or dtype.shape:
        raise BadRequest(f"an array of {dtype}, not of numbers", hint=_HINT)
    if len(shape) > DIMENSIONS_MAX or any(type(side) is not int or side < 0 for side in shape):
        raise BadRequest(
            f"an array of shape {str(shape)[:80]}",
            hint=f"send at most {DIMENSIONS_MAX} dimensions of 0 or more",
        )
    needed, there = math.prod(shape) * dtype.itemsize, len(data) - offset
    if needed != there:
        raise BadRequest(f"an array of {needed} bytes by its header has {there}", hint=_HINT)
    return numpy.frombuffer(data, dtype, offset=offset) if needed else numpy.empty(0, dtype)


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
    numbers = flat(payload, dtype, shape, stream.tell())
    return numbers.reshape(shape, order="F" if fortran else "C").copy()
