"""The engine's whole state as plain JSON and back: where a log begins that is not the daemon's
whole life.

A graph of objects: every container and instance once, by number, so that what was shared stays
shared. Only classes of the core and its ids are ever made, without running any of their code.
`freeze` is the part that must be quick: a copy at one moment, on the decision path; everything else
can happen on another thread.
"""

import importlib
import io
import pickle
import sys
from collections import OrderedDict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from operator import attrgetter
from typing import Any, cast

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.schemas.codec import CodecError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

_HOMES = ("vram_arbiter.arbiter.core.", "vram_arbiter.schemas.ids", "vram_arbiter.schemas.wire.")

type Ref = list[int]


# -- a copy at one moment --------------------------------------------------------------------------
def freeze(arbiter: Arbiter) -> bytes:
    """The state as it is now, in a form for `thaw` in this very process.

    Some microseconds per lease.
    """
    sink = io.BytesIO()
    pickler = pickle.Pickler(sink, protocol=pickle.HIGHEST_PROTOCOL)
    pickler.dispatch_table = _reducers()
    pickler.dump(arbiter)
    return sink.getvalue()


def thaw(frozen: bytes) -> Arbiter:
    """Only for bytes that `freeze` made in this process: files hold JSON, nothing that could
    run."""
    return cast(Arbiter, pickle.loads(frozen))


type _Reduce = Callable[[Any], tuple[Any, ...]]

_known_reducers: dict[type, _Reduce] = {}


def _reducers() -> dict[type, _Reduce]:
    """Frozen dataclasses with slots pickle themselves slowly; their constructor and values do it in
    a third of the time. Maps with bookkeeping of their own are copied as they are, not built up
    again.
    """
    if not _known_reducers:
        for name, module in list(sys.modules.items()):
            if name.startswith(_HOMES):
                for cls in vars(module).values():
                    if isinstance(cls, type) and is_dataclass(cls) and _is_frozen(cls):
                        _known_reducers[cls] = _reducer(cls)
                    elif _is_map(cls):
                        _known_reducers[cls] = _reduce_map
    return _known_reducers


def _is_frozen(cls: type) -> bool:
    found: Any = cls  # the stub of dataclasses lacks the attribute
    return bool(found.__dataclass_params__.frozen)


def _is_map(cls: object) -> bool:
    return isinstance(cls, type) and issubclass(cls, dict) and cls.__module__.startswith(_HOMES)


def _reduce_map(value: Any) -> tuple[Any, ...]:
    return _new, (type(value),), (dict(value), dict(_attributes(value))), None, None, _set_map


def _new(cls: Any) -> Any:
    return cls.__new__(cls)


def _set_map(made: Any, state: tuple[Mapping[Any, Any], JsonMap]) -> None:
    dict.update(made, state[0])
    for name, value in state[1].items():
        object.__setattr__(made, name, value)


def _reducer(cls: type) -> _Reduce:
    names = [field.name for field in fields(cls)]
    if len(names) < 2:
        return lambda value: (cls, tuple(getattr(value, name) for name in names))
    values = attrgetter(*names)
    return lambda value: (cls, values(value))


# -- state → JSON ----------------------------------------------------------------------------------
def to_plain(arbiter: Arbiter) -> JsonObject:
    """`{"objects": […], "root": n}`.

    Raises CodecError for a state that holds more than data (a function, a file).
    """
    graph = _Graph()
    root = graph.value(arbiter)
    return {"root": root[0], "objects": graph.objects}


class _Graph:
    def __init__(self) -> None:
        self.objects: list[Any] = []
        self._seen: dict[int, Ref] = {}
        self._alive: list[Any] = []  # so that no id is used twice while we look

    def value(self, value: Any) -> Any:
        """Plain values as they are, everything else as `[number]`."""
        if value is None or type(value) in (bool, int, float, str):
            return value
        if (ref := self._seen.get(id(value))) is not None:
            return ref
        ref = self._seen[id(value)] = [len(self.objects)]
        self._alive.append(value)
        self.objects.append(None)
        self.objects[ref[0]] = self._entry(value)
        return ref

    def _entry(self, value: Any) -> Any:
        kind = type(value)
        if kind in (list, tuple, set, frozenset):
            return [kind.__name__, [self.value(item) for item in value]]
        if kind in (dict, OrderedDict):
            return [
                kind.__name__,
                [[self.value(key), self.value(item)] for key, item in value.items()],
            ]
        if kind is deque:
            return ["deque", value.maxlen, [self.value(item) for item in value]]
        if not kind.__module__.startswith(_HOMES):
            raise CodecError(
                f"{kind.__module__}.{kind.__qualname__} has no place in the engine's state"
            )
        name = f"{kind.__module__}:{kind.__qualname__}"
        if isinstance(value, Enum):
            return ["enum", name, value.value]
        if isinstance(value, tuple):
            return ["named", name, [self.value(item) for item in value]]
        attributes = {key: self.value(item) for key, item in _attributes(value)}
        if isinstance(value, dict):
            pairs = [[self.value(key), self.value(item)] for key, item in dict.items(value)]
            return ["map", name, pairs, attributes]
        return ["object", name, attributes]


def _attributes(value: Any) -> Iterable[tuple[str, Any]]:
    names = dict.fromkeys(getattr(value, "__dict__", {}))
    for cls in type(value).__mro__:
        slots = vars(cls).get("__slots__", ())
        names |= dict.fromkeys((slots,) if isinstance(slots, str) else slots)
    return ((name, getattr(value, name)) for name in names if hasattr(value, name))


# -- JSON → state ----------------------------------------------------------------------------------
def from_plain(data: JsonMap) -> Arbiter:
    """The engine as it was.

    Raises CodecError if this version's classes are others, or the data is nothing of ours.
    """
    try:
        found = _Builder(data["objects"]).build(data["root"])
    except (KeyError, IndexError, TypeError, ValueError, AttributeError, RecursionError) as error:
        raise CodecError(
            f"the engine's state cannot be read: {type(error).__name__}: {error}"
        ) from error
    if not isinstance(found, Arbiter):
        raise CodecError(
            f"the engine's state holds a {type(found).__name__} where the engine should be"
        )
    return found


class _Builder:
    """Mutable things first as empty shells, so that circles close; what can be a key is whole
    before it is used as one.
    """

    def __init__(self, objects: list[Any]) -> None:
        self._objects = objects
        self._made: dict[int, Any] = {}
        self._open: list[int] = []

    def build(self, root: int) -> Any:
        made = self._make(root)
        while self._open:
            self._fill(self._open.pop())
        return made

    def _value(self, value: Any) -> Any:
        return self._make(value[0]) if isinstance(value, list) else value

    def _make(self, index: int) -> Any:
        if index not in self._made:
            self._made[index] = self._new(index, self._objects[index])
        return self._made[index]

    def _new(self, index: int, entry: Any) -> Any:
        match entry:
            case ["tuple", items]:
                return tuple(self._value(item) for item in items)
            case ["frozenset", items]:
                return frozenset(self._value(item) for item in items)
            case ["enum", name, value]:
                return _class(name)(value)
            case ["named", name, items] if issubclass(cls := _class(name), tuple):
                return cls(*[self._value(item) for item in items])
            case ["object", name, attributes] if _keylike(cls := _class(name)):
                made = object.__new__(cls)
                self._set(made, cls, attributes)
                return made
        self._open.append(index)
        match entry:
            case ["list", _]:
                return []
            case ["set", _]:
                return set()
            case ["dict", _]:
                return {}
            case ["OrderedDict", _]:
                return OrderedDict()
            case ["deque", maxlen, _]:
                return deque(maxlen=maxlen)
            case ["object", name, _]:
                return object.__new__(_class(name))
            case ["map", name, _, _] if _is_map(cls := _class(name)):
                return dict.__new__(cls)
        raise CodecError(f"no such thing as {entry!r}")

    def _fill(self, index: int) -> None:
        made, entry = self._made[index], self._objects[index]
        match entry[0]:
            case "list" | "deque":
                made.extend(self._value(item) for item in entry[-1])
            case "set":
                made.update(self._value(item) for item in entry[1])
            case "dict" | "OrderedDict":
                made.update((self._value(key), self._value(item)) for key, item in entry[1])
            case "map":
                dict.update(made, ((self._value(key), self._value(item)) for key, item in entry[2]))
                self._set(made, type(made), entry[3])
            case _:
                self._set(made, type(made), entry[2])

    def _set(self, made: Any, cls: type, attributes: JsonMap) -> None:
        if is_dataclass(cls):
            names = {field.name for field in fields(cls)}
            if names != attributes.keys():
                raise CodecError(
                    f"{cls.__name__} has other fields: {sorted(names ^ attributes.keys())}"
                )
        for name, value in attributes.items():
            object.__setattr__(made, name, self._value(value))


def _keylike(cls: type) -> bool:
    return is_dataclass(cls) and _is_frozen(cls)


def _class(name: str) -> Any:
    module, _, qualified = name.partition(":")
    if not module.startswith(_HOMES) or not qualified.isidentifier():
        raise CodecError(f"{name} is no class of the engine")
    found = getattr(importlib.import_module(module), qualified, None)
    if not isinstance(found, type) or found.__module__ != module:
        raise CodecError(f"{name} is no class of the engine")
    return found
