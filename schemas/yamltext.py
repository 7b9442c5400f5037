"""The product's only YAML loader: text or path → plain data and the line of each key, or a
ConfigError with every place.

Only YAML's plain types are read: maps with single values as keys, lists, strings, numbers,
booleans, null, dates. Size of the file, nesting, number of values (aliases expanded) and length of
a number are bounded, so that no file ends in a traceback, a full memory or a hang. A key given
twice is an error instead of the last one winning.
"""

import difflib
import os
import re
import reprlib
import stat
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from pathlib import Path as FilePath
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.plain import JsonMap

Path = tuple[str | int, ...]
"""Keys and list positions from the top of a document to one value."""

TEXT_MAX_BYTES = 1 << 20
NODES_MAX = 100_000
"""More values than any file that a person writes; aliases that multiply (`billion laughs`) end
here."""
DEPTH_MAX = 64
NUMBER_MAX_CHARACTERS = 100
"""Longest text of a value that is not a string: converting a number costs the square of
its length."""

_TAG = "tag:yaml.org,2002:"
_TAGS = {
    f"{_TAG}{name}"
    for name in ["null", "bool", "int", "float", "str", "seq", "map", "timestamp", "merge"]
}


@dataclass(frozen=True, slots=True)
class Mistake:
    """One mistake in one file. `line` and `column` count from 1; 0 means the file, or the line, as
    a whole."""

    line: int
    field: str
    problem: str
    column: int = 0

    def text(self, name: str) -> str:
        """`arbiter.yaml:12: verify.tiemout_s: unknown key; …`"""
        place = ":".join(str(number) for number in (self.line, self.column) if number)
        where = f"{name}:{place}" if place else name
        return (
            f"{where}: {self.field}: {self.problem}" if self.field else f"{where}: {self.problem}"
        )


@dataclass(frozen=True, slots=True)
class YamlText:
    """A parsed document. `lines` holds the line (from 1) at which the key of each path stands."""

    name: str
    data: Any
    lines: Mapping[Path, int]

    def line(self, path: Path) -> int:
        """Line of a path, or of its nearest parent that is in the text (a missing key has no line
        of its own)."""
        for end in range(len(path), -1, -1):
            if (found := self.lines.get(path[:end])) is not None:
                return found
        return 0


def read_text(path: FilePath, *, hint: str = "", trusted: bool = False) -> str:
    """Return the text of a file of at most TEXT_MAX_BYTES. `trusted`: no other user but root can
    have written it. Raises ConfigError that names the path."""
    try:
        with path.open("rb") as file:
            if trusted:
                check_owner(path, file.fileno())
            content = file.read(TEXT_MAX_BYTES + 1)
    except (OSError, ValueError) as error:  # ValueError: a path with a NUL character
        reason = getattr(error, "strerror", None) or error
        raise ConfigError(f"{path} cannot be read: {reason}", hint=hint) from error
    return _text_of(content, str(path))


def check_owner(path: FilePath, opened: int) -> None:
    """Raises ConfigError for a file that another user but root may have written. The open file is
    looked at: its path may name another one by now."""
    found = os.fstat(opened)
    if found.st_uid not in (0, os.geteuid()) or found.st_mode & stat.S_IWOTH:
        raise ConfigError(
            f"{path} may be written by other users",
            hint=f"chown {os.geteuid()} {path} && chmod o-w {path}",
        )


def read_yaml(path: FilePath, *, hint: str = "") -> YamlText:
    """Parse the file at `path`. Raises ConfigError: it cannot be read, or every mistake with its
    line."""
    return parse_yaml(read_text(path, hint=hint), str(path))


def parse_yaml(content: str | bytes, name: str) -> YamlText:
    """Parse one document. `name` is how errors call it. An empty text is an empty map.

    Raises ConfigError (details.fields: line, column, field, problem) on broken YAML, tags beyond
    YAML's plain types, keys given twice, values that contain themselves, and more than the limits
    above allow.
    """
    text = _text_of(content, name)
    loader = None
    try:
        loader = _Loader(text)
        root = loader.get_single_node()
        if root is None:
            return YamlText(name, {}, {(): 1})
        survey = _Survey()
        survey.of(root, ())
        if survey.problems:
            raise config_error(name, sorted(survey.problems, key=lambda problem: problem.line))
        lines: dict[Path, int] = {(): root.start_mark.line + 1}
        _note_lines(root, (), lines)
        return YamlText(name, loader.construct_document(root), lines)
    except yaml.reader.ReaderError as error:  # a control character
        line = text.count("\n", 0, error.position) + 1
        column = error.position - text.rfind("\n", 0, error.position)
        what = f"not valid YAML: {error.reason}"
        raise config_error(name, [Mistake(line, "", what, column)]) from error
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = " ".join(part for part in (error.context, error.problem) if part)
        line, column = (mark.line + 1, mark.column + 1) if mark else (0, 0)
        raise config_error(name, [Mistake(line, "", f"not valid YAML: {what}", column)]) from error
    except (yaml.YAMLError, ValueError, OverflowError) as error:  # such as "\UFFFFFFFF"
        line = 0 if loader is None else loader.line + 1
        raise config_error(name, [Mistake(line, "", f"not valid YAML: {error}")]) from error
    finally:
        if loader is not None:
            loader.dispose()


class _Loader(yaml.SafeLoader):
    """SafeLoader that refuses deep nesting and a crowd of values while it composes, and gives wrong
    values their place."""

    def __init__(self, text: str) -> None:
        self._depth = self._nodes = 0
        super().__init__(text)

    def compose_node(self, parent: Any, index: Any) -> Any:
        self._depth += 1
        self._nodes += 1
        if self._depth > DEPTH_MAX or self._nodes > NODES_MAX:
            deep = self._depth > DEPTH_MAX
            limit = (
                f"nested deeper than {DEPTH_MAX} levels"
                if deep
                else f"more than {NODES_MAX} values"
            )
            mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
            raise yaml.composer.ComposerError(None, None, limit, mark)
        try:
            return super().compose_node(parent, index)
        finally:
            self._depth -= 1

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError, OverflowError) as error:
            kind = node.tag.removeprefix(_TAG)
            shown = f"{node.value!r} cannot be read as {kind}: {error}"
            raise yaml.constructor.ConstructorError(None, None, shown, node.start_mark) from error


class _Survey:
    """Look at composed nodes before anything is made of them: tags, keys, texts, and what aliases
    multiply."""

    def __init__(self) -> None:
        self.problems: list[Mistake] = []
        self._known: dict[int, tuple[int, int]] = {}  # node → values in it, and levels
        self._open: set[int] = set()

    def of(self, node: yaml.Node, path: Path) -> tuple[int, int]:
        """Return the number of values and of levels of a node, aliases expanded."""
        if id(node) in self._open:
            self._say(node, path, "contains itself")
            return 1, 1
        if id(node) in self._known:
            return self._known[id(node)]
        self._open.add(id(node))
        if node.tag not in _TAGS:
            shown = node.tag.replace(_TAG, "!!")
            self._say(node, path, f"the tag {shown} is not read here: only YAML's plain types are")
        if isinstance(node, yaml.MappingNode):
            parts = self._pairs(node, path)
        elif isinstance(node, yaml.SequenceNode):
            parts = [self.of(item, (*path, index)) for index, item in enumerate(node.value)]
        else:
            parts = []
            self._scalar(node, path)
        size = 1 + sum(values for values, _ in parts)
        levels = 1 + max((levels for _, levels in parts), default=0)
        if size > NODES_MAX or levels > DEPTH_MAX:
            limit = (
                f"more than {NODES_MAX} values"
                if size > NODES_MAX
                else f"nested deeper than {DEPTH_MAX} levels"
            )
            raise yaml.composer.ComposerError(
                None, None, f"{limit}, aliases expanded", node.start_mark
            )
        self._open.discard(id(node))
        self._known[id(node)] = size, levels
        return size, levels

    def _pairs(self, node: yaml.MappingNode, path: Path) -> list[tuple[int, int]]:
        parts = []
        seen: dict[str, int] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._say(key, path, "a key must be a single value, not a list or a map")
                continue
            self.of(key, path)
            name, line = str(key.value), key.start_mark.line + 1
            if name in seen:
                self._say(key, (*path, name), f"key given twice; first in line {seen[name]}")
            seen.setdefault(name, line)
            parts.append(self.of(value, (*path, name)))
        return parts

    def _scalar(self, node: yaml.Node, path: Path) -> None:
        if node.tag != f"{_TAG}str" and len(node.value) > NUMBER_MAX_CHARACTERS:
            kind = node.tag.removeprefix(_TAG)
            self._say(node, path, f"{len(node.value)} characters are too many for the type {kind}")
        if "\0" in node.value or any("\ud800" <= character <= "\udfff" for character in node.value):
            self._say(
                node, path, "holds a character that no text may hold (NUL or half a surrogate pair)"
            )

    def _say(self, node: yaml.Node, path: Path, problem: str) -> None:
        mark = node.start_mark
        self.problems.append(Mistake(mark.line + 1, dotted(path), problem, mark.column + 1))


def _note_lines(node: yaml.Node, path: Path, lines: dict[Path, int]) -> None:
    if isinstance(node, yaml.MappingNode):
        for key, value in node.value:
            lines[(*path, str(key.value))] = key.start_mark.line + 1
            _note_lines(value, (*path, str(key.value)), lines)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*path, index)] = item.start_mark.line + 1
            _note_lines(item, (*path, index), lines)


def _text_of(content: str | bytes, name: str) -> str:
    if len(content) > TEXT_MAX_BYTES:
        raise config_error(name, [Mistake(0, "", f"larger than {TEXT_MAX_BYTES} bytes")])
    try:
        return content.decode("utf-8-sig") if isinstance(content, bytes) else content
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1  # type: ignore[arg-type]
        what = f"not UTF-8 text: {error.reason} at byte {error.start}"
        raise config_error(name, [Mistake(line, "", what)]) from error


def dotted(path: Path) -> str:
    """`verify.poll_s[0]`"""
    text = ""
    for part in path:
        text += f"[{part}]" if isinstance(part, int) else f".{part}" if text else str(part)
    return text


def did_you_mean(word: str, known: Collection[str]) -> str:
    """`; did you mean timeout_s?`, else the list of what is known."""
    close = difflib.get_close_matches(word, list(known), n=1, cutoff=0.6)
    return f"; did you mean {close[0]}?" if close else f"; known here: {', '.join(sorted(known))}"


def config_error(name: str, problems: list[Mistake]) -> ConfigError:
    """All mistakes of a file as one typed error: a line of text for each, and the fields for
    programs."""
    return ConfigError(
        "\n".join(problem.text(name) for problem in problems),
        details={
            "file": name,
            "fields": [
                {"line": p.line, "column": p.column, "field": p.field, "problem": p.problem}
                for p in problems
            ],
        },
    )


def validated[M: BaseModel](
    model: type[M], source: YamlText, known: Mapping[Path, Collection[str]] | None = None
) -> M:
    """Return the document as `model`. Raises ConfigError with every mistake and its line."""
    try:
        return model.model_validate(source.data)
    except ValidationError as error:
        known = {(): list(model.model_fields)} if known is None else known
        raise config_error(source.name, problems_of(error, source, known)) from error


def problems_of(
    error: ValidationError, source: YamlText, known: Mapping[Path, Collection[str]]
) -> list[Mistake]:
    """Pydantic's findings with the lines of the text. `known` lists the keys of each section, for
    suggestions."""
    problems = []
    for finding in error.errors(include_url=False):
        if only_counts_wrong_entries(finding):
            continue
        path: Path = tuple(finding["loc"])
        if finding["type"] == "extra_forbidden":
            text = "unknown key" + did_you_mean(str(path[-1]), known.get(path[:-1], ()))
        else:
            text = _said(finding)
        problems.append(Mistake(source.line(path), dotted(path), text))
    return sorted(problems, key=lambda problem: problem.line)


def _said(finding: JsonMap) -> str:
    """Return what is wrong, with the value: `must be a valid number, not 'abc'`."""
    if finding["type"] == "missing":
        return "is missing"
    text = str(finding["msg"]).removeprefix("Value error, ").removeprefix("Assertion failed, ")
    before, should, wanted = text.partition("Input should be ")
    if before or not should:
        return text
    wanted = re.sub(r", unable to .*| or instance of \w+", "", wanted)
    return f"must be {wanted}, not {reprlib.repr(finding['input'])}"


def only_counts_wrong_entries(finding: JsonMap) -> bool:
    """Whether a finding says "too short" of a list that is long enough: pydantic does not count
    wrong entries, which have findings of their own."""
    given = finding["input"]
    return (
        finding["type"] == "too_short"
        and isinstance(given, list | tuple)
        and len(given) >= finding["ctx"]["min_length"]
    )
