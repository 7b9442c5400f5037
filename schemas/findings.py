"""What is wrong with a value, field by field, in words that say what to write instead.

Turns pydantic's findings and our own rules into one list of `Problem`s. Knows nothing of YAML:
lines are added where a text was read.
"""

import difflib
import re
import reprlib
from collections.abc import Collection, Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from enum import EnumType
from typing import Final, get_args, get_origin

from pydantic import BaseModel, ValidationError

from vram_arbiter.schemas.plain import JsonMap

_WORDS: Final = {
    "a valid tuple": "a list",
    "a valid list": "a list",
    "a valid dictionary": "a mapping of fields",
}
_shown = reprlib.Repr(maxstring=100).repr

Path = tuple[str | int, ...]
"""Keys and list positions from the top of a document to one value."""


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
        return dotted(self.path)

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


def raise_if(problems: Sequence[Problem]) -> None:
    """Raise RuleError if there is any problem."""
    if problems:
        raise RuleError(problems)


def misplaced(values: object, rules: Mapping[str, str], of: str) -> list[Problem]:
    """Return what a block that is `of` a kind lacks, or must not say: by field, `R` is required,
    `F` forbidden, `-` free."""
    problems = []
    for field, rule in rules.items():
        given = bool(getattr(values, field))
        if (rule == "R" and not given) or (rule == "F" and given):
            verb = "is required for" if rule == "R" else "is not allowed for"
            problems.append(Problem((field,), f"{verb} {of!r}"))
    return problems


def wrong(problem: str, *path: str | int) -> RuleError:
    """Return the error of one finding."""
    return RuleError([Problem(path, problem)])


def dotted(path: Path) -> str:
    """`actuators_required[0].kind`"""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def did_you_mean(word: str, known: Collection[str]) -> str:
    """`; did you mean timeout_s?`, else the list of what is known."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    if not known:
        return ""
    return f"; did you mean {close[0]}?" if close else f"; known here: {', '.join(sorted(known))}"


def problems_of(error: ValidationError, model: type[BaseModel], data: object) -> list[Problem]:
    """Pydantic's findings of `model` over `data`, in the order of the fields, one per place and
    message."""
    problems: dict[Problem, None] = {}
    for finding in error.errors(include_url=False):
        if _only_counts_wrong_entries(finding):
            continue
        path = _path_in(data, finding["loc"], missing=finding["type"] == "missing")
        cause = finding.get("ctx", {}).get("error")
        if isinstance(cause, RuleError):
            found = [problem.below(path) for problem in cause.problems]
        else:
            found = [Problem(path, _said(finding, path, model))]
        problems.update(dict.fromkeys(found))
    return list(problems)


def _only_counts_wrong_entries(finding: JsonMap) -> bool:
    """Whether a finding says "too short" of a list that is long enough: pydantic does not count
    wrong entries, which have findings of their own."""
    given = finding["input"]
    return (
        finding["type"] == "too_short"
        and isinstance(given, list | tuple)
        and len(given) >= finding["ctx"]["min_length"]
    )


def _path_in(data: object, loc: Path, *, missing: bool) -> Path:
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


def _said(finding: JsonMap, path: Path, model: type[BaseModel]) -> str:
    """Return what is wrong, with the value: `must be a valid number, not 'abc'`."""
    kind, value, context = finding["type"], finding["input"], finding.get("ctx", {})
    owner = _model_at(model, path[:-1])
    field = owner.model_fields.get(str(path[-1])) if owner and path else None
    described = (field and field.description) or ""
    if field and isinstance(field.annotation, EnumType):
        described = "one of " + ", ".join(repr(str(word)) for word in field.annotation)
    if kind == "missing":
        return f"is missing: {described}" if described else "is missing"
    if kind == "extra_forbidden":
        return "unknown key" + did_you_mean(str(path[-1]), owner.model_fields if owner else ())
    if kind == "string_pattern_mismatch":
        wanted = described or f"of the form {context['pattern']}"
        return f"{_shown(value)} is not {wanted}"
    if kind in ("enum", "literal_error"):
        words = re.findall(r"'([^']*)'", context["expected"])
        return f"{_shown(value)} is not one of {context['expected']}" + (
            did_you_mean(str(value), words) if difflib.get_close_matches(str(value), words) else ""
        )
    text = re.sub(
        r", unable to .*|, got a number .*| or instance of \w+| after validation",
        "",
        finding["msg"],
    )
    text = re.sub(r"^(Value error|Assertion failed), ", "", text)
    wanted = text.removeprefix("Input should be ")
    if wanted != text:
        quoted = "; put it in quotes" if kind == "string_type" else ""
        return f"must be {_WORDS.get(wanted, wanted)}, not {_shown(value)}{quoted}"
    return re.sub(r"^(Tuple|List|Dictionary|String) should ", "must ", text)


def _model_at(model: type[BaseModel] | None, path: Path) -> type[BaseModel] | None:
    """Return the model of the value at a path; None where there is none."""
    keyed = False  # the next key is one of a map, not a field
    for key in path:
        if keyed or isinstance(key, int) or model is None:
            keyed = False
            continue
        named = model.model_fields.get(key)
        field = named or model.model_fields.get("root")
        model = _model_in(field.annotation) if field else None
        keyed = named is not None and _is_map(named.annotation)
    return model


def _model_in(annotation: object) -> type[BaseModel] | None:
    """Return the first model in an annotation, such as `tuple[M, ...] | None`."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        return annotation
    found = [_model_in(argument) for argument in get_args(annotation)]
    return next((model for model in found if model is not None), None)


def _is_map(annotation: object) -> bool:
    return get_origin(annotation) is dict or any(map(_is_map, get_args(annotation)))
