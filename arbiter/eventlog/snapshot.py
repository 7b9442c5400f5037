"""The engine's whole state as plain JSON and back: where a log begins that is not the daemon's
whole life.

A graph of objects: every container and instance once, by number, so that what was shared stays
shared. Only classes of the core and its ids are ever made, without running any of their code.
`to_plain` is on the decision path, some 0.1 ms per lease; everything else can happen on another
thread.
"""

import importlib
from collections import OrderedDict, deque
from collections.abc import Iterable
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType
from typing import Any

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.schemas.codec import CodecError
from vram_arbiter.schemas.plain import JsonMap, JsonObject

_HOMES = ("vram_arbiter.arbiter.core.", "vram_arbiter.schemas.ids", "vram_arbiter.schemas.wire.")

type Ref = list[int]

_PLAIN = frozenset((NoneType, bool, int, float, str))


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
        if type(value) in _PLAIN:
            return value
        if (ref := self._seen.get(id(value))) is not None:
            return ref
        ref = self._seen[id(value)] = [len(self.objects)]
        self._alive.append(value)
        self.objects.append(None)
        self.objects[ref[0]] = self._entry(value)
        return ref

    def _values(self, items: Iterable[Any]) -> list[Any]:
        return [item if type(item) in _PLAIN else self.value(item) for item in items]

    def _entry(self, value: Any) -> Any:
        kind: Any = type(value)
        if kind in (list, tuple, set, frozenset):
            return [kind.__name__, self._values(value)]
        if kind in (dict, OrderedDict):
            return [kind.__name__, [self._values(pair) for pair in value.items()]]
        if kind is deque:
            return ["deque", value.maxlen, self._values(value)]
        name = _name(kind)
        if isinstance(value, Enum):
            return ["enum", name, value.value]
        if isinstance(value, tuple):
            return ["named", name, self._values(value)]
        attributes = _attributes(value)
        plain = dict(zip(attributes, self._values(attributes.values()), strict=True))
        if isinstance(value, dict):
            return ["map", name, [self._values(pair) for pair in dict.items(value)], plain]
        return ["object", name, plain]


@cache
def _name(kind: type) -> str:
    """Raises CodecError for a class that is not the engine's."""
    if not kind.__module__.startswith(_HOMES):
        raise CodecError(
            f"{kind.__module__}.{kind.__qualname__} has no place in the engine's state"
        )
    return f"{kind.__module__}:{kind.__qualname__}"


def _attributes(value: Any) -> dict[str, Any]:
    kind: Any = type(value)
    found = dict(getattr(value, "__dict__", ()))
    for name in _slots(kind):
        if hasattr(value, name):
            found[name] = getattr(value, name)
    return found


@cache
def _slots(kind: type) -> tuple[str, ...]:
    names: dict[str, None] = {}
    for cls in kind.__mro__:
        slots = vars(cls).get("__slots__", ())
        names |= dict.fromkeys((slots,) if isinstance(slots, str) else slots)
    names.pop("__dict__", None)
    return tuple(names)


def _is_frozen(cls: type) -> bool:
    found: Any = cls  # the stub of dataclasses lacks the attribute
    return bool(found.__dataclass_params__.frozen)


def _is_map(cls: object) -> bool:
    return isinstance(cls, type) and issubclass(cls, dict) and cls.__module__.startswith(_HOMES)


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
