"""The product's only YAML loader: text or path → plain data and the line of each key, or a
ConfigError with every place.

Only YAML's plain types are read: maps with single values as keys, lists, strings, numbers,
booleans, null, dates. Size of the file, nesting, number of values (aliases expanded) and length of
a number are bounded, so that no file ends in a traceback, a full memory or a hang. A key is the
text that stands in the file (`on`, `7`, not a truth value or a number), and one given twice is an
error. PyYAML's nodes carry the lines; other loaders do, too, but would need the same bounds.
"""

import os
import stat
from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path as FilePath
from typing import Any

import yaml
from pydantic import BaseModel, ValidationError

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import Path, dotted, problems_of

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
    """Raise ConfigError for a file that a user other than this one and root may have written.

    `opened` is its descriptor, because the path may name another file by now.
    """
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
        walk = _Walk()
        walk.visit(root, (), root)
        if walk.problems:
            raise config_error(name, [walk.problems[place] for place in sorted(walk.problems)])
        return YamlText(name, loader.construct_document(root), walk.lines)
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
        mark = self.peek_event().start_mark  # type: ignore[no-untyped-call]
        _check_limits(self._depth - 1, self._nodes, mark)
        try:
            node = super().compose_node(parent, index)
        finally:
            self._depth -= 1
        is_key = isinstance(parent, yaml.MappingNode) and index is None
        return _text_key(node) if is_key and isinstance(node, yaml.ScalarNode) else node

    def construct_object(self, node: yaml.Node, deep: bool = False) -> Any:
        try:
            return super().construct_object(node, deep)
        except (ValueError, LookupError, AttributeError, TypeError, OverflowError) as error:
            kind = node.tag.removeprefix(_TAG)
            shown = f"{node.value!r} cannot be read as {kind}: {error}"
            raise yaml.constructor.ConstructorError(None, None, shown, node.start_mark) from error


class _Walk:
    """Looks at composed nodes, aliases expanded, before anything is made of them: tags, keys,
    texts and limits. Notes the line of each path."""

    def __init__(self) -> None:
        self.lines: dict[Path, int] = {}
        self.problems: dict[tuple[int, int], Mistake] = {}
        self._open: list[yaml.Node] = []

    def visit(self, node: yaml.Node, path: Path, at: yaml.Node) -> None:
        """`at` is the node whose line the path has: the key, or the value itself."""
        self.lines[path] = at.start_mark.line + 1
        if any(outer is node for outer in self._open):
            self._say(node, path, "contains itself")
            return
        first = (*self._open[1:2], node)[0]  # what is at the top, not what an alias stands for
        _check_limits(len(self._open), len(self.lines), first.start_mark, ", aliases expanded")
        if node.tag not in _TAGS:
            shown = node.tag.replace(_TAG, "!!")
            self._say(node, path, f"the tag {shown} is not read here: only YAML's plain types are")
        self._open.append(node)
        if isinstance(node, yaml.MappingNode):
            self._visit_pairs(node, path)
        elif isinstance(node, yaml.SequenceNode):
            for index, item in enumerate(node.value):
                self.visit(item, (*path, index), item)
        else:
            self._check_text(node, path)
        self._open.pop()

    def _visit_pairs(self, node: yaml.MappingNode, path: Path) -> None:
        seen: dict[str, int] = {}
        for key, value in node.value:
            if not isinstance(key, yaml.ScalarNode):
                self._say(key, path, "a key must be a single value, not a list or a map")
                continue
            inner = (*path, key.value)
            if key.value in seen:
                self._say(key, inner, f"key given twice; first in line {seen[key.value]}")
                continue
            seen[key.value] = key.start_mark.line + 1
            self.visit(key, inner, key)
            self.visit(value, inner, key)

    def _check_text(self, node: yaml.Node, path: Path) -> None:
        if node.tag != f"{_TAG}str" and len(node.value) > NUMBER_MAX_CHARACTERS:
            kind = node.tag.removeprefix(_TAG)
            self._say(node, path, f"{len(node.value)} characters are too many for the type {kind}")
        if "\0" in node.value or any("\ud800" <= character <= "\udfff" for character in node.value):
            self._say(
                node, path, "holds a character that no text may hold (NUL or half a surrogate pair)"
            )

    def _say(self, node: yaml.Node, path: Path, problem: str) -> None:
        place = node.start_mark.line + 1, node.start_mark.column + 1
        self.problems.setdefault(place, Mistake(place[0], dotted(path), problem, place[1]))


def _text_key(key: yaml.ScalarNode) -> yaml.ScalarNode:
    """Return a key as the text that stands in the file."""
    if key.tag not in _TAGS - {f"{_TAG}merge"}:
        return key
    return yaml.ScalarNode(f"{_TAG}str", key.value, key.start_mark, key.end_mark)


def _check_limits(depth: int, values: int, mark: Any, how: str = "") -> None:
    """Raise ComposerError beyond the limits."""
    if depth >= DEPTH_MAX or values > NODES_MAX:
        limit = (
            f"nested deeper than {DEPTH_MAX} levels"
            if depth >= DEPTH_MAX
            else f"more than {NODES_MAX} values"
        )
        raise yaml.composer.ComposerError(None, None, limit + how, mark)


def _text_of(content: str | bytes, name: str) -> str:
    if len(content) > TEXT_MAX_BYTES:
        raise config_error(name, [Mistake(0, "", f"larger than {TEXT_MAX_BYTES} bytes")])
    try:
        return content.decode("utf-8-sig") if isinstance(content, bytes) else content
    except UnicodeDecodeError as error:
        line = content[: error.start].count(b"\n") + 1  # type: ignore[arg-type]
        what = f"not UTF-8 text: {error.reason} at byte {error.start}"
        raise config_error(name, [Mistake(line, "", what)]) from error


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


def without_empty(model: type[BaseModel], source: YamlText) -> YamlText:
    """Return a document without its empty sections: `verify:` with all its keys commented out is
    no mistake. An empty key that `model` does not know stays, and is one."""
    if not isinstance(source.data, dict):
        return source
    given = {
        key: value
        for key, value in source.data.items()
        if value is not None or key not in model.model_fields
    }
    return replace(source, data=given)


def validated[M: BaseModel](model: type[M], source: YamlText) -> M:
    """Return the document as `model`. Raises ConfigError with every mistake and its line."""
    try:
        return model.model_validate(source.data)
    except ValidationError as error:
        mistakes = [
            Mistake(source.line(found.path), found.field, found.message)
            for found in problems_of(error, model, source.data)
        ]
        raise config_error(source.name, sorted(mistakes, key=lambda found: found.line)) from error
