"""Frozen dataclasses ⇄ plain JSON, by their type hints alone: a new event, or a new field with a
default, needs no code here.

Encoding goes by value (what JSON cannot say is a dataclass or a mapping), decoding by hint. Numbers
come back as they were: nothing is converted, so that a replay sees the very same values. The digest
of effects is over all their bytes, in order. Knows nothing of files.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, fields, is_dataclass
from enum import Enum
from functools import cache
from hashlib import blake2b
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any, Literal, NewType, TypeAliasType, Union, get_args, get_origin, get_type_hints

import msgpack

from vram_arbiter.arbiter.core.effects import Effect, Note, Push
from vram_arbiter.arbiter.core.events import Event

type _Decode = Callable[[Any], Any]

_PLAIN = (str, int, float, bool, NoneType)


class CodecError(ValueError):
    """A value that another version, or another program, wrote; the message says which
    field."""


# -- values → JSON
@cache
def _names(cls: type) -> tuple[str, ...]:
    return tuple(field.name for field in fields(cls))


def _as_plain(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return {name: getattr(value, name) for name in _names(type(value))}
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, set | frozenset):
        return sorted(value)
    raise TypeError(f"{type(value).__name__} has no place in a log")


_JSON = json.JSONEncoder(separators=(",", ":"), default=_as_plain)


def to_json(value: Any) -> str:
    """One line. Raises TypeError for what is neither plain, a dataclass nor a mapping."""
    return _JSON.encode(value)


# -- JSON → values
@cache
def event_types() -> Mapping[str, type]:
    """Every event of the core by its name."""
    return {cls.__name__: cls for cls in get_args(Event)}


def decode_event(name: str, data: Any) -> Event:
    """Raises CodecError for an event, a field or a shape that this version does not know."""
    known = event_types().get(name)
    if known is None:
        raise CodecError(f"no event is called {name}")
    event: Event = decode(known, data)
    return event


def decode[T](cls: type[T], data: Any) -> T:
    """A dataclass from its plain form. Raises CodecError."""
    hint: Any = cls
    value: T = _decoder(hint)(data)
    return value


@cache
def _decoder(hint: Any) -> _Decode:
    """How a value of this hint is made from its plain form; built once a hint."""
    if isinstance(hint, NewType):
        return _decoder(hint.__supertype__)
    if isinstance(hint, TypeAliasType):
        return _decoder(hint.__value__)
    origin = get_origin(hint)
    if hint in _PLAIN or hint is Any or origin is Literal:
        return _same
    if origin is not None:
        return _generic_decoder(hint, origin)
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass_decoder(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint
    raise CodecError(f"{hint} has no place in a log")


def _same(data: Any) -> Any:
    return data


def _generic_decoder(hint: Any, origin: Any) -> _Decode:
    arguments = get_args(hint)
    if origin in (Union, UnionType):
        return _union_decoder(arguments)
    if origin is tuple:
        if len(arguments) == 2 and arguments[1] is Ellipsis:
            item = _decoder(arguments[0])
            return lambda data: tuple(item(value) for value in _listed(data))
        items = [_decoder(argument) for argument in arguments]
        return lambda data: tuple(
            decode(value) for decode, value in zip(items, _listed(data, len(items)), strict=True)
        )
    if origin in (list, set, frozenset, Sequence):
        item = _decoder(arguments[0])
        make: Any = list if origin is Sequence else origin
        return lambda data: make(item(value) for value in _listed(data))
    if issubclass(origin, Mapping):
        value_of = _decoder(arguments[1])
        return lambda data: {key: value_of(value) for key, value in _mapped(data).items()}
    raise CodecError(f"{hint} has no place in a log")


def _listed(data: Any, count: int | None = None) -> list[Any]:
    if not isinstance(data, list | tuple) or count not in (None, len(data)):
        raise CodecError(f"a list was expected, not {data!r}")
    return list(data)


def _mapped(data: Any) -> Mapping[str, Any]:
    if not isinstance(data, Mapping):
        raise CodecError(f"a map was expected, not {data!r}")
    return data


def _union_decoder(arguments: Sequence[Any]) -> _Decode:
    """None and plain values stand for themselves; of several dataclasses the one with these fields
    is meant."""
    classes = [hint for hint in arguments if isinstance(hint, type) and is_dataclass(hint)]
    rest = [hint for hint in arguments if hint not in classes and hint is not NoneType]
    other = _decoder(rest[0]) if rest else _same

    def choose(data: Any) -> Any:
        if data is None:
            return None
        if isinstance(data, Mapping):
            for cls in classes:
                if data.keys() <= set(_names(cls)):
                    return _decoder(cls)(data)
        return other(data)

    return choose


def _dataclass_decoder(cls: type) -> _Decode:
    hints = get_type_hints(cls)
    # late: a dataclass may hold its own kind
    decoders: dict[str, _Decode] = {}
    required = {
        f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING
    }
    names = frozenset(_names(cls))

    def make(data: Any) -> Any:
        given = _mapped(data)
        if not decoders:
            decoders.update({name: _decoder(hints[name]) for name in names})
        if unknown := given.keys() - names:
            raise CodecError(f"{cls.__name__} has no field {', '.join(sorted(unknown))}")
        if missing := required - given.keys():
            raise CodecError(f"{cls.__name__} lacks {', '.join(sorted(missing))}")
        return cls(**{name: decoders[name](value) for name, value in given.items()})

    return make


# -- effects
@cache
def _getter(cls: type) -> Callable[[Any], tuple[Any, ...]]:
    names = _names(cls)
    if len(names) == 1:
        only = attrgetter(names[0])
        return lambda value: (only(value),)
    return attrgetter(*names) if names else lambda value: ()


def _packable(value: Any) -> Any:
    if is_dataclass(value) and not isinstance(value, type):
        return [type(value).__name__, *_getter(type(value))(value)]
    return _as_plain(value)


def digest(effects: Sequence[Effect]) -> str:
    """16 hex digits over every byte of the effects, in their order. The same decisions give the
    same digest, on any machine."""
    packed = msgpack.packb([_packable(effect) for effect in effects], default=_packable)
    return blake2b(packed, digest_size=8).hexdigest()


def summary(effects: Sequence[Effect]) -> str:
    """The effects by kind, e.g. `Reply Note:queued Push:revoke`: what to look at where digests
    differ."""
    return " ".join(
        f"Note:{effect.kind}"
        if isinstance(effect, Note)
        else f"Push:{effect.body.TAG[1]}"
        if isinstance(effect, Push)
        else type(effect).__name__
        for effect in effects
    )
