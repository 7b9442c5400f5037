"""What is wrong with a manifest, field by field, in words that say what to write instead.

Turns pydantic's findings and our own rules into one list of `Problem`s. Knows nothing of YAML;
lines are added by the loader.
"""

import difflib
import types
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import Enum
from typing import Annotated, Any, Literal, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from vram_arbiter.schemas.errors import ManifestInvalid
from vram_arbiter.schemas.yamltext import only_counts_wrong_entries

Path = tuple[str | int, ...]


@dataclass(frozen=True, slots=True)
class Problem:
    """One finding: where, what is wrong and what would be right, and the line of the file
    if known."""

    path: Path
    message: str
    line: int | None = None
    column: int | None = None

    @property
    def field(self) -> str:
        """The path as people write it, e.g. `actuators_required[0].kind`; empty for the file as a
        whole."""
        text = ""
        for part in self.path:
            text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else part
        return text

    def __str__(self) -> str:
        return f"{self.field}: {self.message}" if self.path else self.message

    def at(self, source: str) -> str:
        """The finding with its place in the file: `rskill.yaml:12: quantization.dtype: …`."""
        place = "".join(f":{number}" for number in (self.line, self.column) if number)
        return f"{source}{place}: {self}"

    def below(self, prefix: Path) -> "Problem":
        """The same finding seen from the enclosing value."""
        return replace(self, path=prefix + self.path)


class RuleError(ValueError):
    """Raised inside validators to report several findings at once, with paths relative to the value
    being validated."""

    def __init__(self, problems: Iterable[Problem]) -> None:
        self.problems = tuple(problems)
        super().__init__("; ".join(map(str, self.problems)))


class ManifestError(ManifestInvalid):
    """A manifest that cannot be used. `problems` lists every finding, `details["fields"]` the same
    as plain data."""

    def __init__(self, source: str, problems: Sequence[Problem]) -> None:
        self.source = source
        self.problems = tuple(problems)
        super().__init__(
            "\n".join(problem.at(source) for problem in self.problems),
            details={
                "source": source,
                "fields": [
                    {"path": problem.field, "problem": problem.message, "line": problem.line}
                    for problem in self.problems
                ],
            },
        )


def raise_if(problems: Sequence[Problem]) -> None:
    """Raise RuleError if there is any problem."""
    if problems:
        raise RuleError(problems)


def one_of(value: object, allowed: Iterable[str]) -> str:
    """`'int3' is not one of 'fp32', …`, with the nearest allowed word when there is one."""
    words = list(allowed)
    text = f"{value!r} is not one of {', '.join(map(repr, words))}"
    return text + _nearest(value, words)


def _nearest(value: object, words: Sequence[str]) -> str:
    near = difflib.get_close_matches(str(value), words, n=1, cutoff=0.7)
    return f"; did you mean {near[0]!r}?" if near else ""


def from_validation_error(
    error: ValidationError, model: type[BaseModel], data: object
) -> list[Problem]:
    """All findings of a ValidationError of `model` over `data`, in the order of the fields, one per
    place and message."""
    problems: dict[Problem, None] = {}
    for item in error.errors(include_url=False):
        if only_counts_wrong_entries(item):
            continue
        path = _path_in(data, item["loc"], missing=item["type"] == "missing")
        cause = item.get("ctx", {}).get("error")
        if isinstance(cause, RuleError):
            found = [problem.below(path) for problem in cause.problems]
        else:
            found = [Problem(path, _message(item, path, model))]
        problems.update(dict.fromkeys(found))
    return list(problems)


def _path_in(data: object, loc: tuple[str | int, ...], *, missing: bool) -> Path:
    """Pydantic's `loc` without the parts that name a union's member or a dict's key instead of a
    place in the data."""
    path: list[str | int] = []
    value = data
    for index, part in enumerate(loc):
        known = (isinstance(value, Mapping) and part in value) or (
            isinstance(value, list | tuple) and isinstance(part, int) and part < len(value)
        )
        if known:
            value = value[part]  # type: ignore[index]
            path.append(part)
        elif missing and index == len(loc) - 1:
            path.append(part)
    return tuple(path)


def _message(item: Any, path: Path, model: type[BaseModel]) -> str:
    kind, value, ctx = item["type"], item["input"], item.get("ctx", {})
    annotation = _annotation_at(model, path)
    match kind:
        case "missing":
            return "is required" + _hint(model, path)
        case "extra_forbidden":
            owner = _model_at(model, path[:-1])
            names = list(owner.model_fields) if owner else []
            return "there is no such field" + (
                _nearest(path[-1], names) or f"; known: {', '.join(names)}"
            )
        case "enum" | "literal_error":
            words = _words(annotation)
            return one_of(value, words) if words else f"{value!r}: {item['msg']}"
        case "string_pattern_mismatch":
            return f"{value!r} is not {_described(model, path) or 'of the form ' + ctx['pattern']}"
        case "greater_than":
            return f"must be greater than {ctx['gt']:g}, not {value!r}"
        case "greater_than_equal":
            return f"must be at least {ctx['ge']:g}, not {value!r}"
        case "less_than_equal":
            return f"must be at most {ctx['le']:g}, not {value!r}"
        case "string_type":
            return f"must be a text, not {value!r}; put it in quotes"
        case "too_short" | "string_too_short":
            return f"must have at least {_count(ctx['min_length'], kind)}"
        case "too_long" | "string_too_long":
            return (
                f"must have at most {_count(ctx['max_length'], kind)}, not "
                f"{ctx.get('actual_length', len(value))}"
            )
        case "model_type" | "model_attributes_type" | "dict_type" | "mapping_type":
            return f"must be a mapping of fields, not {value!r}"
        case "tuple_type" | "list_type":
            return f"must be a list, not {value!r}"
        case "int_parsing" | "int_type" | "int_from_float":
            return f"must be a whole number, not {value!r}"
        case "float_parsing" | "float_type":
            return f"must be a number, not {value!r}"
        case "bool_parsing" | "bool_type":
            return f"must be true or false, not {value!r}"
        case "value_error":
            return str(ctx["error"])
        case _:
            return f"{item['msg'][:1].lower()}{item['msg'][1:]}, not {value!r}"


def _count(number: int, kind: str) -> str:
    one, many = ("character", "characters") if kind.startswith("string") else ("entry", "entries")
    return f"{number} {one if number == 1 else many}"


def _hint(model: type[BaseModel], path: Path) -> str:
    annotation = _annotation_at(model, path)
    words = _words(annotation)
    if words:
        return f": one of {', '.join(map(repr, words))}"
    described = _described(model, path)
    return f": {described}" if described else ""


def _described(model: type[BaseModel], path: Path) -> str:
    owner = _model_at(model, path[:-1])
    field = owner.model_fields.get(str(path[-1])) if owner and path else None
    return (field.description or "") if field else ""


def _annotation_at(model: type[BaseModel], path: Path) -> object:
    """The type that the models ask for at a path; None where they say nothing."""
    annotation: object = model
    for part in path:
        owner = _model_in(annotation)
        if isinstance(part, int):
            annotation = next(iter(_arguments(annotation, (tuple, list))), None)
        elif owner is not None:
            field = owner.model_fields.get(part)
            annotation = field.annotation if field else None
        # a dict: a wrong key is judged by the type of keys, a wrong value by the type of values
        else:
            arguments = _arguments(annotation, (dict,))
            annotation = arguments[0] if arguments else None
    return annotation


def _model_at(model: type[BaseModel], path: Path) -> type[BaseModel] | None:
    return _model_in(_annotation_at(model, path))


def _model_in(annotation: object) -> type[BaseModel] | None:
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    for argument in (
        get_args(annotation)
        if get_origin(annotation) in (Union, types.UnionType, Annotated)
        else ()
    ):
        if found := _model_in(argument):
            return found
    return None


def _arguments(annotation: object, origins: tuple[type, ...]) -> tuple[object, ...]:
    if get_origin(annotation) in origins:
        return get_args(annotation)
    for argument in (
        get_args(annotation)
        if get_origin(annotation) in (Union, types.UnionType, Annotated)
        else ()
    ):
        if found := _arguments(argument, origins):
            return found
    return ()


def _words(annotation: object) -> list[str]:
    """The words that an enum or a Literal allows, also inside `X | None`."""
    if isinstance(annotation, type) and issubclass(annotation, Enum):
        return [str(member.value) for member in annotation]
    if get_origin(annotation) is Literal:
        return [str(word) for word in get_args(annotation)]
    if get_origin(annotation) in (Union, types.UnionType, Annotated):
        return [word for argument in get_args(annotation) for word in _words(argument)]
    return []
