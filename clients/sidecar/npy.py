"""Arrays on the sidecar wire: `{"__ndarray_class__": true, "as_npy": <bytes of numpy's .npy format>}`, never pickle.

numpy is imported inside the functions: the base install has none, and whoever sends no arrays needs none.
"""

import io
import sys
from typing import Any

from schemas.errors import BadRequest

MARK = "__ndarray_class__"
BYTES = "as_npy"


def pack(value: Any) -> Any:
    """A copy of nested maps and lists with every array (and torch-free numpy scalar) made plain."""
    numpy = sys.modules.get("numpy")  # without it loaded nobody can have made an array
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
    """The inverse of `pack`. Raises BadRequest for bytes that are no array; object arrays are refused."""
    if isinstance(value, dict):
        if value.get(MARK) is True and BYTES in value:
            return _array(value[BYTES])
        return {key: unpack(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [unpack(item) for item in value]
    return value


def _array(payload: object) -> Any:
    import numpy

    if not isinstance(payload, bytes):
        raise BadRequest(f"{BYTES} holds {type(payload).__name__}, not bytes", hint="send numpy.save output")
    try:
        return numpy.load(io.BytesIO(payload), allow_pickle=False)
    except (ValueError, EOFError, OSError) as error:
        raise BadRequest(f"not an array in .npy format: {error}", hint="send numpy.save output") from error
