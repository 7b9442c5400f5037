"""Dataclasses whose fields have the types that they declare: mypy cannot see what a wire, a journal
or a mutant puts there."""

from collections.abc import Callable
from dataclasses import fields, is_dataclass
from functools import cache
from types import UnionType
from typing import (
    Annotated,
    Any,
    Literal,
    NewType,
    TypeAliasType,
    Union,
    get_args,
    get_origin,
    get_type_hints,
)

type _Check = Callable[[Any], bool]


def mistyped(value: object) -> str:
    """Return the first field of a dataclass that is not of its type, as `Class.field`; "": all
    are."""
    cls: Any = type(value)
    for name, fits in _fields(cls):
        if not fits(getattr(value, name)):
            return f"{type(value).__name__}.{name}: {getattr(value, name)!r}"
    return ""


def missing(value: object) -> str:
    """Return the first field of a dataclass that is None and may not be, as `Class.field`; "" if
    there is none. A look for records that change with every event."""
    cls: Any = type(value)
    names = _required(cls)
    if None not in [getattr(value, name) for name in names]:
        return ""
    return next(f"{cls.__name__}.{name}" for name in names if getattr(value, name) is None)


@cache
def _required(cls: Any) -> list[str]:
    hints = get_type_hints(cls)
    return [field.name for field in fields(cls) if type(None) not in get_args(hints[field.name])]


@cache
def _fields(cls: Any) -> list[tuple[str, _Check]]:
    hints = get_type_hints(cls)
    return [(field.name, _check(hints[field.name])) for field in fields(cls)]


def _check(hint: Any) -> _Check:
    """Return whether a value fits a type; items of a mapping or a sequence are not examined."""
    while isinstance(hint, NewType | TypeAliasType):
        hint = hint.__supertype__ if isinstance(hint, NewType) else hint.__value__
    origin, parts = get_origin(hint), get_args(hint)
    if origin is Annotated:
        return _check(parts[0])
    if origin is Literal:
        return lambda value: value in parts
    if origin in (Union, UnionType):
        either = [_check(part) for part in parts]
        return lambda value: any(fits(value) for fits in either)
    if origin is tuple and parts[1:] == (Ellipsis,):
        each = _check(parts[0])
        return lambda value: isinstance(value, tuple) and all(map(each, value))
    if origin is tuple:
        items = [_check(part) for part in parts]
        return lambda value: (
            isinstance(value, tuple)
            and len(value) == len(items)
            and all(fits(item) for fits, item in zip(items, value, strict=True))
        )
    if origin is not None or hint is Any:
        kind: Any = object if origin is None else origin
        return lambda value: isinstance(value, kind)
    if hint in (int, float):
        return lambda value: isinstance(value, int | hint) and not isinstance(value, bool)
    if issubclass(hint, tuple):
        return lambda value: isinstance(value, hint) and None not in value
    cls: type = hint
    return lambda value: isinstance(value, cls) and not (is_dataclass(value) and mistyped(value))
