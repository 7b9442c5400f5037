"""The engine's whole state as one text and back: where a log begins that is not the daemon's whole
life.

`freeze` is the part that must be quick: a pickle at one moment, on the decision path. The writer's
thread packs it, and `unpack` makes only classes of the engine and its ids from a text, by an
unpickler that knows no others: a log may be another user's file. The text names the fields of the
engine's classes, so that a version with others refuses it.
"""

import base64
import io
import pickle
import sys
import zlib
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from functools import cache
from operator import attrgetter
from typing import Any, Final

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.schemas.codec import CodecError
from vram_arbiter.schemas.plain import JsonMap

_HOMES = ("vram_arbiter.arbiter.core.", "vram_arbiter.schemas.ids", "vram_arbiter.schemas.wire.")

type _Reduce = Callable[[Any], tuple[Any, ...]]


def freeze(arbiter: Arbiter) -> bytes:
    """Return the state as it is now. Some microseconds per lease."""
    sink = io.BytesIO()
    pickler = pickle.Pickler(sink, protocol=pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = _reducers()
    pickler.dump((_shapes(), arbiter))
    return sink.getvalue()


def pack(frozen: bytes) -> str:
    """Return a frozen state as a text without line breaks."""
    return base64.b85encode(zlib.compress(frozen, 1)).decode()


def unpack(text: str) -> Arbiter:
    """Return the engine as it was. Raises CodecError if this version's classes are others, or the
    text is nothing of ours."""
    try:
        reader = _Reader(io.BytesIO(zlib.decompress(base64.b85decode(text))))
        shapes, found = reader.load()
        for cls in filter(is_dataclass, reader.used):
            if (written := shapes[_name(cls)]) != (own := _names(cls)):
                odd = sorted(set(written) ^ set(own))
                raise CodecError(f"{cls.__name__} has other fields: {odd}")
    except CodecError:
        raise
    except Exception as error:  # a pickle of another program may raise anything
        raise CodecError(
            f"the engine's state cannot be read: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(found, Arbiter):
        raise CodecError(
            f"the engine's state holds a {type(found).__name__} where the engine should be"
        )
    return found


# -- pickling
@cache
def _classes() -> tuple[type, ...]:
    """Return the engine's classes, as far as they are imported: all of them once it runs."""
    return tuple(
        cls
        for name, module in list(sys.modules.items())
        if name.startswith(_HOMES)
        for cls in vars(module).values()
        if isinstance(cls, type) and cls.__module__ == name
    )


@cache
def _shapes() -> Mapping[str, tuple[str, ...]]:
    """Return the fields of the engine's dataclasses by their names."""
    return {_name(cls): _names(cls) for cls in _classes() if is_dataclass(cls)}


def _name(cls: type) -> str:
    return f"{cls.__module__}:{cls.__qualname__}"


def _names(cls: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(cls))


@cache
def _reducers() -> dict[type, _Reduce]:
    """Frozen dataclasses with slots pickle themselves slowly; their constructor and values do it in
    a third of the time. Maps with bookkeeping of their own are copied as they are, not built up
    again.
    """
    found: dict[type, _Reduce] = {}
    for cls in _classes():
        made: Any = cls  # the stub of dataclasses lacks the attribute
        if is_dataclass(cls) and made.__dataclass_params__.frozen:
            found[cls] = _reducer(cls)
        elif issubclass(cls, dict):
            found[cls] = _reduce_map
    return found


def _reducer(cls: type) -> _Reduce:
    names = _names(cls)
    if len(names) < 2:
        return lambda value: (cls, tuple(getattr(value, name) for name in names))
    values = attrgetter(*names)
    return lambda value: (cls, values(value))


def _reduce_map(value: Any) -> tuple[Any, ...]:
    return _new_map, (type(value),), (dict(value), dict(_attributes(value))), None, None, _set_map


def _new_map(cls: Any) -> Any:
    return dict.__new__(cls)


def _set_map(made: Any, state: tuple[Mapping[Any, Any], JsonMap]) -> None:
    dict.update(made, state[0])
    for name, value in state[1].items():
        object.__setattr__(made, name, value)


def _attributes(value: Any) -> Iterable[tuple[str, Any]]:
    names = dict.fromkeys(getattr(value, "__dict__", {}))
    for cls in type(value).__mro__:
        slots = vars(cls).get("__slots__", ())
        names |= dict.fromkeys((slots,) if isinstance(slots, str) else slots)
    return ((name, getattr(value, name)) for name in names if hasattr(value, name))


class _Reader(pickle.Unpickler):
    """Knows the engine's classes, and two containers of the standard library."""

    _OTHERS: Final = {
        (known.__module__, known.__name__): known
        for known in (OrderedDict, deque, _new_map, _set_map)
    }

    def __init__(self, source: io.BytesIO) -> None:
        super().__init__(source)
        self.used: set[type] = set()

    def find_class(self, module: str, name: str) -> Any:
        if (other := self._OTHERS.get((module, name))) is not None:
            return other
        found = getattr(sys.modules.get(module), name, None)
        if not module.startswith(_HOMES) or not isinstance(found, type):
            raise CodecError(f"{module}.{name} is no class of the engine")
        if found.__module__ != module:
            raise CodecError(f"{module}.{name} is no class of the engine")
        self.used.add(found)
        return found
