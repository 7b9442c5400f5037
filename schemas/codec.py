"""Frozen dataclasses ⇄ plain maps, driven by type hints: the one codec of replies, pushes, journal
records and event logs.

Each class gets one encoder and one decoder, generated as source on first use, as the standard
library generates `__init__`. They call those of the classes they hold by name, so a class may hold
its own kind.

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
from threading import RLock
from types import NoneType, UnionType
from typing import Any, Literal, NewType, TypeAliasType, Union, get_args, get_origin, get_type_hints

from vram_arbiter.schemas.plain import JsonMap, JsonObject

type _Convert = Callable[[Any], Any]

_PLAIN = (str, int, float, bool, NoneType, object)


class CodecError(ValueError):
    """A plain value that does not fit its class; the message names the class and the field."""


def to_map(value: object) -> JsonObject:
    """Return the map of a dataclass. Raises TypeError for anything else."""
    cls = type(value)
    encoded: JsonObject = (_ENCODERS.get(cls) or _made(_ENCODERS, cls, _write_encoder, cls))(value)
    return encoded


def from_map[T](cls: type[T], data: object, *, strict: bool = False) -> T:
    """Return the dataclass that a map stands for. Raises CodecError."""
    key = (cls, strict)
    decoded: T = (_DECODERS.get(key) or _made(_DECODERS, key, _write_decoder, cls, strict))(data)
    return decoded


def encoders(*classes: type) -> Mapping[type, Callable[[Any], JsonObject]]:
    """Write the encoders of dataclasses now, so that no first message waits for them."""
    return {cls: _made(_ENCODERS, cls, _write_encoder, cls) for cls in classes}


# -- generated source
_ENCODERS: dict[type, _Convert] = {}
_DECODERS: dict[tuple[type, bool], _Convert] = {}
_NAMES: dict[object, str] = {}
"""What is written of a class → name of its function in `_SPACE`."""
_SPACE: JsonObject = {"MISSING": MISSING}
"""Names that generated source refers to: its functions, and what they need."""
_WRITING = RLock()


def _made[K](made: dict[K, _Convert], key: K, write: Callable[..., str], *of: object) -> _Convert:
    """Write a class's function and those that it calls; keep it once all of them are there."""
    with _WRITING:
        sources: list[str] = []
        name = write(*of, sources)
        exec("\n".join(sources), _SPACE)
        made[key] = _SPACE[name]
    return made[key]


def _named(value: object) -> str:
    """Make a value known to generated source, and return its name there."""
    name = f"_{len(_SPACE)}"
    _SPACE[name] = value
    return name


# -- values → maps
def _write_encoder(cls: Any, sources: list[str]) -> str:
    """Write the function that encodes a class, and those of the classes it holds. Return its
    name."""
    if (known := _NAMES.get(cls)) is not None:
        return known
    if not is_dataclass(cls):
        raise TypeError(f"{cls.__name__} is not a dataclass and has no plain form")
    name = _NAMES[cls] = _named(None)
    hints, tag = get_type_hints(cls), getattr(cls, "TAG", None)
    always = [f"{tag[0]!r}: {tag[1]!r}"] if tag else []
    lines: list[str] = []
    for field in fields(cls):
        part = field.metadata.get("part")
        key, needed = part or field.name, _is_required(field) or getattr(cls, "WHOLE", False)
        value = f"o.{field.name}" if needed else "v"
        plain = f"{value}.{part}" if part else _encoding(hints[field.name], value, sources)
        if needed:
            always.append(f"{key!r}: {plain}")
        else:
            lines += [f"    v = o.{field.name}", f"    if {_differs(field)}: d[{key!r}] = {plain}"]
    head = [f"def {name}(o):", f"    d = {{{', '.join(always)}}}"]
    sources.append("\n".join([*head, *lines, "    return d"]))
    return name


def _differs(field: "Field[Any]") -> str:
    default = field.default
    if field.default_factory is not MISSING:
        default = field.default_factory()
    if default is None:
        return "v is not None"
    if isinstance(default, bool | str | tuple) and not default:
        return "v"
    return f"v != {_named(default)}"


def _encoding(hint: Any, value: str, sources: list[str]) -> str:
    """Return an expression for the plain form of `value`; `value` itself where nothing has to be
    done."""
    hint = _resolved(hint)
    if _stands_for_itself(hint):
        return value
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        rest = [argument for argument in arguments if argument is not NoneType]
        if len(rest) > 1:
            return f"{_named(_any_plain)}({value})"
        inner = _encoding(rest[0], value, sources)
        return value if inner == value else f"(None if {value} is None else {inner})"
    if origin is not None and issubclass(origin, Mapping):
        inner = _encoding(arguments[1], "i", sources)
        return value if inner == "i" else f"{{k: {inner} for k, i in {value}.items()}}"
    if origin is tuple and arguments[1:] != (Ellipsis,):
        plain = all(_stands_for_itself(_resolved(argument)) for argument in arguments)
        return value if plain else f"{_named(_any_plain)}({value})"
    if origin is not None:
        inner = _encoding(arguments[0], "i", sources)
        if inner == "i":
            return f"sorted({value})" if origin in (set, frozenset) else value
        return f"[{inner} for i in {value}]"
    if isinstance(hint, type) and issubclass(hint, tuple):
        return f"list({value})"
    exact = isinstance(hint, type) and is_dataclass(hint) and not hasattr(hint, "TAG")
    exact = exact and not hint.__subclasses__()
    return f"{_write_encoder(hint, sources) if exact else _named(to_map)}({value})"


def _any_plain(value: Any) -> Any:
    if isinstance(value, list | tuple):
        return [_any_plain(item) for item in value]
    return to_map(value) if is_dataclass(value) else value


# -- maps → values
def _write_decoder(cls: Any, strict: bool, sources: list[str]) -> str:
    """Write the function that decodes a class, and those of the classes it holds. Return its
    name."""
    if (known := _NAMES.get((cls, strict))) is not None:
        return known
    if not is_dataclass(cls):
        raise CodecError(f"{cls} has no plain form")
    name, own, checked = _named(None), _named(cls), _named(_checked)
    _NAMES[cls, strict] = name
    hints, arguments = get_type_hints(cls), []
    for field in fields(cls):
        key = field.name
        if _is_required(field):
            made = _decoding(hints[key], f"d[{key!r}]", strict, sources)
        else:
            default = _named(field.default)
            if field.default is MISSING:
                default = f"{_named(field.default_factory)}()"
            inner = _decoding(hints[key], "v", strict, sources)
            made = f"{inner} if (v := d.get({key!r}, MISSING)) is not MISSING else {default}"
        arguments.append(f"{key}={made}")
    check = ["    if type(d) is not dict:", f"        {checked}({own}, d, False)"]
    if strict:
        check = [f"    {checked}({own}, d, True)"]
    sources.append(
        "\n".join([
            f"def {name}(d):", *check,
            "    try:", f"        return {own}({', '.join(arguments)})",
            "    except KeyError:", f"        {_named(_check_complete)}({own}, d)", "        raise",
        ])
    )  # fmt: skip
    return name


def _decoding(hint: Any, value: str, strict: bool, sources: list[str]) -> str:
    """Return an expression for what the plain form `value` stands for; `value` itself where nothing
    has to be done."""
    hint = _resolved(hint)
    if isinstance(hint, type) and issubclass(hint, Enum):
        known = _named({code.value: code for code in hint})
        return f"{_named(hint)}({value})" if strict else f"{known}.get({value}, {value})"
    if _stands_for_itself(hint):
        return value
    origin, arguments = get_origin(hint), get_args(hint)
    if origin in (Union, UnionType):
        return _union_decoding(arguments, value, strict, sources)
    if isinstance(hint, type) and issubclass(hint, tuple):
        count = len(get_type_hints(hint))
        fits, checked = f"type({value}) is list and len({value}) == {count}", _named(_listed)
        return f"{_named(hint)}(*({value} if {fits} else {checked}({value}, {count})))"
    if origin is None:
        return f"{_write_decoder(hint, strict, sources)}({value})"
    listed = _named(_listed)
    if origin is tuple and arguments[1:] != (Ellipsis,):
        items = [_decoding(one, f"i[{n}]", strict, sources) for n, one in enumerate(arguments)]
        return f"(lambda i: ({', '.join(items)},))({listed}({value}, {len(items)}))"
    if issubclass(origin, Mapping):
        inner = _decoding(arguments[1], "i", strict, sources)
        return f"{{k: {inner} for k, i in {_named(_mapped)}({value}).items()}}"
    inner = _decoding(arguments[0], "i", strict, sources)
    make = "tuple" if origin is Sequence else origin.__name__
    found = f"{listed}({value})"
    return f"{make}({found})" if inner == "i" else f"{make}([{inner} for i in {found}])"


def _union_decoding(arguments: Sequence[Any], value: str, strict: bool, sources: list[str]) -> str:
    """None and plain values stand for themselves; of several dataclasses the tag decides, else the
    fields."""
    options = [_resolved(argument) for argument in arguments if argument is not NoneType]
    classes = [option for option in options if is_dataclass(option)]
    others = [option for option in options if option not in classes]
    if len(options) == 1 or not classes:
        inner = _decoding(options[0], value, strict, sources)
    else:
        names = {cls: _write_decoder(cls, strict, sources) for cls in classes}
        tags = {cls.TAG: name for cls, name in names.items() if hasattr(cls, "TAG")}
        untagged = [
            (frozenset(field.name for field in fields(cls)), name)
            for cls, name in names.items()
            if not hasattr(cls, "TAG")
        ]
        other = _decoding(others[0], "v", strict, sources) if others else "v"
        otherwise = _named(None)
        sources.append(f"def {otherwise}(v):\n    return {other}")

        def choose(data: Any) -> Any:
            if isinstance(data, Mapping):
                for (key, kind), name in tags.items():
                    if data.get(key) == kind:
                        return _SPACE[name](data)
                for known, name in untagged:
                    if data.keys() <= known:
                        return _SPACE[name](data)
            return _SPACE[otherwise](data)

        inner = f"{_named(choose)}({value})"
    optional = NoneType in arguments and inner != value
    return f"(None if {value} is None else {inner})" if optional else inner


def _checked(cls: Any, data: Any, strict: bool) -> None:
    if not isinstance(data, Mapping):
        raise CodecError(f"{cls.__name__}: expected a map, got {data!r:.80}")
    known = {field.name for field in fields(cls)} | {getattr(cls, "TAG", ("",))[0]}
    if strict and (unknown := data.keys() - known):
        raise CodecError(f"{cls.__name__} has no field {', '.join(sorted(unknown))}")


def _check_complete(cls: Any, data: JsonMap) -> None:
    required = {field.name for field in fields(cls) if _is_required(field)}
    if missing := required - data.keys():
        raise CodecError(f"{cls.__name__} lacks {', '.join(sorted(missing))}") from None


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
