"""Frozen dataclasses ⇄ plain maps, driven by type hints: the one codec of replies, pushes, journal
records and event logs.

Each class gets one table of its fields for each direction, made on first use: a row says how the
field's value is converted, `None` where it stands for itself.

Rules of the plain form:
- A field that has its default is left out, unless its class has `WHOLE = True`; a missing field
  takes its default.
- A named tuple is the list of its fields (`[epoch, serial]`).
- A class with `TAG = (key, value)` says its kind under that key; a union of such classes is decoded
  by it.
- A field with the metadata `part` is that attribute of its value, under the attribute's name.
- Text enumerations are their values. Numbers stay as they are.

A lenient decoder ignores fields and keeps codes that it does not know: they come from a newer
program. A strict one raises CodecError for them. Standard library only; knows no message and no
file.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache, partial
from operator import attrgetter
from types import NoneType, UnionType
from typing import Any, Literal, NewType, TypeAliasType, Union, get_args, get_origin, get_type_hints

from vram_arbiter.schemas.plain import JsonMap, JsonObject

type _Convert = Callable[[Any], Any]

_PLAIN = (str, int, float, bool, NoneType, object)


class CodecError(ValueError):
    """A plain value that does not fit its class; the message names the class and the field."""


def to_map(value: object) -> JsonObject:
    """Return the map of a dataclass. Raises TypeError for anything else."""
    cls: Any = type(value)
    return _encoder(cls)(value)


def from_map[T](cls: type[T], data: object, *, strict: bool = False) -> T:
    """Return the dataclass that a map stands for. Raises CodecError."""
    any_class: Any = cls
    decoded: T = _decoder(any_class, strict)(data)
    return decoded


def encoders(*classes: type) -> Mapping[type, Callable[[Any], JsonObject]]:
    """Return the encoders of dataclasses."""
    return {cls: _encoder(cls) for cls in classes}


# -- values → maps
type _Row = tuple[str, object, _Convert | None]
"""Key, default (MISSING: the field is always written) and conversion of one field."""


@cache
def _encoder(cls: Any) -> Callable[[Any], JsonObject]:
    """Return what encodes a class. Its table is made with its first value, so that a class may hold
    its own kind."""
    if not is_dataclass(cls):
        raise TypeError(f"{cls.__name__} is not a dataclass and has no plain form")
    names, tag = [field.name for field in fields(cls)], getattr(cls, "TAG", None)
    always = {tag[0]: tag[1]} if tag else {}
    # of one attribute it would return that, of none nothing
    values_of = attrgetter(*names, "__class__", "__class__")
    table = cache(partial(_encoded_fields, cls))

    def encode(value: Any) -> JsonObject:
        encoded: JsonObject = always.copy()
        for (key, default, convert), item in zip(table(), values_of(value), strict=False):
            if item is not default and (default is MISSING or item != default):
                encoded[key] = item if convert is None else convert(item)
        return encoded

    return encode


def _encoded_fields(cls: Any) -> list[_Row]:
    """Return the table of an encoder."""
    hints, rows, whole = get_type_hints(cls), [], getattr(cls, "WHOLE", False)
    for field in fields(cls):
        part = field.metadata.get("part")
        made = MISSING if field.default_factory is MISSING else field.default_factory()
        default = MISSING if whole else made if field.default is MISSING else field.default
        convert = attrgetter(part) if part else _encoding(hints[field.name])
        rows.append((part or field.name, default, convert))
    return rows


def _encoding(hint: Any) -> _Convert | None:
    """Return what makes the plain form of a value; None: it stands for itself."""
    hint = cls = _resolved(hint)
    if _stands_for_itself(hint):
        return None
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        rest = [argument for argument in arguments if argument is not NoneType]
        several = _any_plain if len(rest) > 1 else _encoding(rest[0])
        return None if several is None else _optional(several)
    if origin is not None and issubclass(origin, Mapping):
        each = _encoding(arguments[1])
        return None if each is None else lambda items: {k: each(i) for k, i in items.items()}
    if origin is tuple and arguments[1:] != (Ellipsis,):
        plain = all(_stands_for_itself(_resolved(argument)) for argument in arguments)
        return None if plain else _any_plain
    if origin is not None:
        inner = _encoding(arguments[0])
        if inner is None:
            return sorted if origin in (set, frozenset) else None
        return lambda items: [inner(item) for item in items]
    if isinstance(hint, type) and issubclass(hint, tuple):
        return list
    exact = not hasattr(cls, "TAG") and not cls.__subclasses__()
    return _encoder(cls) if exact else to_map


def _optional(inner: _Convert) -> _Convert:
    return lambda value: None if value is None else inner(value)


def _any_plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_any_plain(item) for item in value]
    return to_map(value) if is_dataclass(value) else value


# -- maps → values
@cache
def _decoder(cls: Any, strict: bool) -> _Convert:
    """Return what decodes a class. Its table is made with its first value."""
    make: Callable[..., Any] = cls
    if not is_dataclass(cls):
        raise CodecError(f"{cls} has no plain form")
    table = cache(partial(_decoded_fields, cls, strict))

    def decode(data: Any) -> Any:
        if strict or type(data) is not dict:
            _check(cls, data, strict)
        values = {}
        for key, convert, required in table():
            item = data.get(key, MISSING)
            if item is not MISSING:
                values[key] = item if convert is None else convert(item)
            elif required:
                raise _lacking(cls, data)
        return make(**values)

    return decode


def _decoded_fields(cls: Any, strict: bool) -> list[tuple[str, _Convert | None, bool]]:
    """Return the table of a decoder: key, conversion, and whether a map must have it."""
    hints = get_type_hints(cls)
    return [
        (field.name, _decoding(hints[field.name], strict), _is_required(field))
        for field in fields(cls)
    ]


def _decoding(hint: Any, strict: bool) -> _Convert | None:
    """Return what makes a value of its plain form; None: that stands for itself."""
    hint = _resolved(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        known = {code.value: code for code in hint}
        return hint if strict else lambda value: known.get(value, value)
    if _stands_for_itself(hint):
        return None
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return _union_decoding(arguments, strict)
    if isinstance(hint, type) and issubclass(hint, tuple):
        count = len(get_type_hints(hint))
        return lambda value: hint(*_listed(value, count))
    if origin is None:
        return _decoder(hint, strict)
    if origin is tuple and arguments[1:] != (Ellipsis,):
        items = [_decoding(argument, strict) for argument in arguments]
        return partial(_decode_items, items)
    if issubclass(origin, Mapping):
        inner = _decoding(arguments[1], strict) or _itself
        return lambda value: {key: inner(item) for key, item in _mapped(value).items()}
    inner_or_none, make = _decoding(arguments[0], strict), tuple if origin is Sequence else origin
    if inner_or_none is None:
        return lambda value: make(_listed(value))
    return lambda value: make([inner_or_none(item) for item in _listed(value)])


def _itself(value: Any) -> Any:
    return value


def _refuse(value: Any) -> Any:
    raise CodecError(f"expected one of several kinds of map, got {value!r:.80}")


def _decode_items(items: Sequence[_Convert | None], value: Any) -> tuple[Any, ...]:
    """Decode a tuple of a fixed length."""
    found = zip(items, _listed(value, len(items)), strict=True)
    return tuple([item if convert is None else convert(item) for convert, item in found])


def _union_decoding(arguments: Sequence[Any], strict: bool) -> _Convert | None:
    """None and plain values stand for themselves; of several dataclasses the tag decides, else the
    fields."""
    options = [_resolved(argument) for argument in arguments if argument is not NoneType]
    classes: list[Any] = [option for option in options if is_dataclass(option)]
    others = [option for option in options if option not in classes]
    if len(options) == 1 or not classes:
        inner = _decoding(options[0], strict)
        return inner if inner is None or NoneType not in arguments else _optional(inner)
    tags = {cls.TAG: _decoder(cls, strict) for cls in classes if hasattr(cls, "TAG")}
    untagged = [
        (frozenset(field.name for field in fields(cls)), _decoder(cls, strict))
        for cls in classes
        if not hasattr(cls, "TAG")
    ]
    otherwise = _decoding(others[0], strict) if others else _refuse if strict else None
    rest = otherwise or _itself

    def choose(data: Any) -> Any:
        if isinstance(data, Mapping):
            for (key, kind), decode in tags.items():
                if data.get(key) == kind:
                    return decode(data)
            for known, decode in untagged:
                if data.keys() <= known:
                    return decode(data)
        return rest(data)

    return _optional(choose) if NoneType in arguments else choose


def _check(cls: Any, data: Any, strict: bool) -> None:
    if not isinstance(data, Mapping):
        raise CodecError(f"{cls.__name__}: expected a map, got {data!r:.80}")
    known = {field.name for field in fields(cls)} | {getattr(cls, "TAG", ("",))[0]}
    if strict and (unknown := data.keys() - known):
        raise CodecError(f"{cls.__name__} has no field {', '.join(sorted(unknown))}")


def _lacking(cls: Any, data: JsonMap) -> CodecError:
    missing = {field.name for field in fields(cls) if _is_required(field)} - data.keys()
    return CodecError(f"{cls.__name__} lacks {', '.join(sorted(missing))}")


def _mapped(data: Any) -> JsonMap:
    if not isinstance(data, Mapping):
        raise CodecError(f"expected a map, got {data!r:.80}")
    return data


def _listed(data: Any, count: int | None = None) -> Sequence[Any]:
    if not isinstance(data, list | tuple) or count not in (None, len(data)):
        raise CodecError(f"expected a list{f' of {count}' if count else ''}, got {data!r:.80}")
    return data


# -- shared
def _is_required(field: "Field[Any]") -> bool:
    return field.default is MISSING and field.default_factory is MISSING


def _resolved(hint: Any) -> Any:
    while True:
        if isinstance(hint, NewType):
            hint = hint.__supertype__
        elif isinstance(hint, TypeAliasType):
            hint = hint.__value__
        elif hasattr(hint, "__metadata__"):  # Annotated
            hint = hint.__origin__
        else:
            return hint


def _stands_for_itself(hint: Any) -> bool:
    if hint in _PLAIN or hint is Any or get_origin(hint) is Literal:
        return True
    return isinstance(hint, type) and issubclass(hint, Enum)
