"""Frozen dataclasses ⇄ plain maps, driven by type hints: the one codec of replies, pushes, journal
records and event logs.

Each class gets one encoder and one decoder, generated on first use, as the standard library
generates `__init__`.

Rules of the plain form:
- A field that has its default is left out, unless its class has `WHOLE = True`; a missing field
  takes its default.
- A class with `COMPACT = True` is the list of its fields (`[epoch, serial]`).
- A class with `TAG = (key, value)` says its kind under that key; a union of such classes is decoded
  by it.
- Text enumerations are their values. Numbers stay as they are.

A lenient decoder ignores fields and keeps codes that it does not know: they come from a newer
program. A strict one raises CodecError for them. Standard library only; knows no message and no
file.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from types import NoneType, UnionType
from typing import Any, Literal, NewType, TypeAliasType, Union, get_args, get_origin, get_type_hints

type _Convert = Callable[[Any], Any]

_PLAIN = (str, int, float, bool, NoneType, object)


class CodecError(ValueError):
    """A plain value that does not fit its class; the message names the class and the field."""


def to_map(value: object) -> dict[str, Any]:
    """Return the map of a dataclass. Raises TypeError for anything else."""
    cls: Any = type(value)
    encoded: dict[str, Any] = _encoder(cls)(value)
    return encoded


def from_map[T](cls: type[T], data: object, *, strict: bool = False) -> T:
    """Return the dataclass that a map stands for. Raises CodecError."""
    hint: Any = cls
    decoded: T = _decoder(hint, strict)(data)
    return decoded


# -- values → maps
@cache
def _encoder(cls: type) -> _Convert:
    """Generate `encode(value)` of a class."""
    if not is_dataclass(cls):
        raise TypeError(f"{cls.__name__} is not a dataclass and has no plain form")
    space: dict[str, Any] = {}
    hints = get_type_hints(cls)
    if getattr(cls, "COMPACT", False):
        items = ", ".join(f"o.{field.name}" for field in fields(cls))
        return _made(f"def made(o):\n    return [{items}]", space)
    always: list[str] = []
    lines: list[str] = []
    if tag := getattr(cls, "TAG", None):
        always.append(f"{tag[0]!r}: {tag[1]!r}")
    for field in fields(cls):
        name = field.name
        if _is_required(field) or getattr(cls, "WHOLE", False):
            always.append(f"{name!r}: {_encoding(hints[name], f'o.{name}', space)}")
        else:
            plain = _encoding(hints[name], "v", space)
            lines += [
                f"    v = o.{name}",
                f"    if {_differs(field, space)}: d[{name!r}] = {plain}",
            ]
    head = f"    d = {{{', '.join(always)}}}"
    return _made("\n".join(["def made(o):", head, *lines, "    return d"]), space)


def _differs(field: "Field[Any]", space: dict[str, Any]) -> str:
    default = field.default
    if field.default_factory is not MISSING:
        default = field.default_factory()
    if default is None:
        return "v is not None"
    if isinstance(default, bool | str | tuple) and not default:
        return "v"
    return f"v != {_named(default, space)}"


def _encoding(hint: Any, value: str, space: dict[str, Any]) -> str:
    """Return an expression for the plain form of `value`; `value` itself where nothing has to be
    done."""
    hint = _resolved(hint)
    if _stands_for_itself(hint):
        return value
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        rest = [argument for argument in arguments if argument is not NoneType]
        if len(rest) > 1:
            return f"{_named(_any_plain, space)}({value})"
        inner = _encoding(rest[0], value, space)
        return value if inner == value else f"(None if {value} is None else {inner})"
    if origin is not None and issubclass(origin, Mapping):
        inner = _encoding(arguments[1], "i", space)
        return value if inner == "i" else f"{{k: {inner} for k, i in {value}.items()}}"
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        if all(_stands_for_itself(_resolved(argument)) for argument in arguments):
            return value
        return f"{_named(_any_plain, space)}({value})"
    if origin is not None:
        inner = _encoding(arguments[0], "i", space)
        if inner == "i":
            return f"sorted({value})" if origin in (set, frozenset) else value
        return f"[{inner} for i in {value}]"
    if fields(hint) and getattr(hint, "TAG", None) is None and not hint.__subclasses__():
        return f"{_named(_late(hint), space)}({value})"
    return f"{_named(to_map, space)}({value})"


def _late(cls: type) -> _Convert:
    """The encoder of a class, made when it is first needed: a class may hold its own kind."""
    made: list[_Convert] = []

    def encode(value: Any) -> Any:
        if not made:
            made.append(_encoder(cls))
        return made[0](value)

    return encode


def _any_plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_any_plain(item) for item in value]
    return to_map(value) if is_dataclass(value) else value


# -- maps → values
@cache
def _decoder(hint: Any, strict: bool) -> _Convert:
    """Return how a value of this hint is made from its plain form."""
    hint = _resolved(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        return hint if strict else _lenient(hint)
    if _stands_for_itself(hint):
        return _same
    if get_origin(hint) is not None:
        return _generic_decoder(hint, strict)
    if (other := getattr(hint, "DECODED_AS", None)) is not None and not is_dataclass(hint):
        return _decoder(other(), strict)
    if is_dataclass(hint) and isinstance(hint, type):
        return _dataclass_decoder(hint, strict)
    raise CodecError(f"{hint} has no plain form")


def _same(data: Any) -> Any:
    return data


def _lenient(codes: type[Enum]) -> _Convert:
    known = {code.value: code for code in codes}
    return lambda data: known.get(data, data)


def _generic_decoder(hint: Any, strict: bool) -> _Convert:
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return _union_decoder(arguments, strict)
    if origin is tuple and not (len(arguments) == 2 and arguments[1] is Ellipsis):
        items = [_decoder(argument, strict) for argument in arguments]
        return lambda data: tuple(
            item(value) for item, value in zip(items, _listed(data, len(items)), strict=True)
        )
    if issubclass(origin, Mapping):
        value_of = _decoder(arguments[1], strict)
        return lambda data: {key: value_of(value) for key, value in _mapped(data).items()}
    if origin in (tuple, list, set, frozenset, Sequence):
        item = _decoder(arguments[0], strict)
        make: Any = tuple if origin is Sequence else origin
        return lambda data: make([item(value) for value in _listed(data)])
    raise CodecError(f"{hint} has no plain form")


def _union_decoder(arguments: Sequence[Any], strict: bool) -> _Convert:
    """None and plain values stand for themselves; of several dataclasses the tag decides, else the
    fields."""
    classes = [
        found
        for found in map(_resolved, arguments)
        if isinstance(found, type) and (is_dataclass(found) or hasattr(found, "DECODED_AS"))
    ]
    rest = [one for one in arguments if _resolved(one) not in classes and one is not NoneType]
    other = _decoder(rest[0], strict) if rest else _same
    if len(classes) == 1 and not rest:
        only = classes[0]
        return lambda data: None if data is None else _decoder(only, strict)(data)
    tags = {cls.TAG: _decoder(cls, strict) for cls in classes if hasattr(cls, "TAG")}
    keys = sorted({key for key, _ in tags})
    untagged = [(frozenset(_names(cls)), cls) for cls in classes if not hasattr(cls, "TAG")]

    def choose(data: Any) -> Any:
        if not isinstance(data, Mapping):
            return other(data)
        for key in keys:
            if (decode := tags.get((key, data.get(key)))) is not None:
                return decode(data)
        for names, cls in untagged:
            if data.keys() <= names:
                return _decoder(cls, strict)(data)
        return other(data)

    return choose


def _dataclass_decoder(cls: Any, strict: bool) -> _Convert:
    made: list[_Convert] = []  # late: a class may hold its own kind
    required = frozenset(field.name for field in fields(cls) if _is_required(field))
    known = frozenset(_names(cls)) | {getattr(cls, "TAG", ("",))[0]}
    compact = getattr(cls, "COMPACT", False)

    def decode(data: Any) -> Any:
        if compact and isinstance(data, list | tuple):
            return cls(*_listed(data, len(required)))
        if not isinstance(data, Mapping):
            raise CodecError(f"{cls.__name__}: expected a map, got {data!r:.80}")
        if strict and (unknown := data.keys() - known):
            raise CodecError(f"{cls.__name__} has no field {', '.join(sorted(unknown))}")
        if not made:
            made.append(_generated_decoder(cls, strict))
        try:
            return made[0](data)
        except KeyError:
            if missing := required - data.keys():
                raise CodecError(f"{cls.__name__} lacks {', '.join(sorted(missing))}") from None
            raise

    return decode


def _generated_decoder(cls: Any, strict: bool) -> _Convert:
    space: dict[str, Any] = {"cls": cls, "M": MISSING}
    hints = get_type_hints(cls)
    arguments: list[str] = []
    for field in fields(cls):
        convert = _decoder(hints[field.name], strict)
        name = field.name
        call = "" if convert is _same else _named(convert, space)
        if _is_required(field):
            arguments.append(f"{name}={call}(d[{name!r}])")
        elif field.default is not MISSING and not call:
            arguments.append(f"{name}=get({name!r}, {_named(field.default, space)})")
        else:
            default = (
                _named(field.default, space)
                if field.default is not MISSING
                else f"{_named(field.default_factory, space)}()"
            )
            value = f"{default} if (v := get({name!r}, M)) is M else {call}(v)"
            arguments.append(f"{name}={value}")
    get = "    get = d.get\n" if any("get(" in one for one in arguments) else ""
    return _made(f"def made(d):\n{get}    return cls({', '.join(arguments)})", space)


# -- shared
def _made(source: str, space: dict[str, Any]) -> _Convert:
    exec(source, space)
    made: _Convert = space["made"]
    return made


def _named(value: Any, space: dict[str, Any]) -> str:
    """Make a value known to generated source, and return its name there."""
    name = f"_{len(space)}"
    space[name] = value
    return name


def _is_required(field: "Field[Any]") -> bool:
    return field.default is MISSING and field.default_factory is MISSING


@cache
def _names(cls: Any) -> tuple[str, ...]:
    return tuple(field.name for field in fields(cls))


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


def _mapped(data: Any) -> Mapping[str, Any]:
    if not isinstance(data, Mapping):
        raise CodecError(f"expected a map, got {data!r:.80}")
    return data


def _listed(data: Any, count: int | None = None) -> list[Any]:
    if not isinstance(data, list | tuple) or count not in (None, len(data)):
        raise CodecError(f"expected a list{f' of {count}' if count else ''}, got {data!r:.80}")
    return list(data)
