"""YAML text → plain data plus the line of every key, so that a mistake can be named as `file:line: key: problem`.

Pure: takes text, never a path to open. Only the safe tags; a key given twice is an error instead of the last one winning.
Used by `schemas.config`; any other file format of the product that people write by hand can use it too.
"""

import difflib
from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import yaml
from pydantic import ValidationError

from schemas.errors import ConfigError

Path = tuple[str | int, ...]
"""Keys and list positions from the top of a document to one value."""

NODES_MAX = 100_000
"""More values than any file that a person writes; aliases that multiply (`billion laughs`) end here."""


@dataclass(frozen=True, slots=True)
class Problem:
    """One mistake in one file. `line` counts from 1; 0 means the file as a whole."""

    line: int
    field: str
    problem: str

    def text(self, name: str) -> str:
        """`arbiter.yaml:12: verify.tiemout_s: unknown key; …`"""
        where = f"{name}:{self.line}" if self.line else name
        return f"{where}: {self.field}: {self.problem}" if self.field else f"{where}: {self.problem}"


@dataclass(frozen=True, slots=True)
class YamlText:
    """A parsed document. `lines` holds the line (from 1) at which the key of each path stands."""

    name: str
    data: Any
    lines: Mapping[Path, int]

    def line(self, path: Path) -> int:
        """Line of a path, or of its nearest parent that is in the text (a missing key has no line of its own)."""
        for end in range(len(path), -1, -1):
            if (found := self.lines.get(path[:end])) is not None:
                return found
        return 0


def parse_yaml(text: str, name: str) -> YamlText:
    """Parse one document. `name` is how errors call it. An empty text is an empty map.

    Raises ConfigError (details.fields: line, field, problem) on broken YAML, unsafe tags and keys given twice.
    """
    try:
        loader = yaml.SafeLoader(text)
    except yaml.reader.ReaderError as error:  # a control character
        line = text.count("\n", 0, error.position) + 1
        raise config_error(name, [Problem(line, "", f"not valid YAML: {error.reason}")]) from error
    try:
        root = loader.get_single_node()
        lines: dict[Path, int] = {(): 1}
        if root is None:
            return YamlText(name, {}, lines)
        _walk(root, (), lines, name, [0])
        return YamlText(name, loader.construct_document(root), lines)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        what = " ".join(part for part in (error.context, error.problem) if part)
        raise config_error(
            name, [Problem(mark.line + 1 if mark else 0, "", f"not valid YAML: {what}")]
        ) from error
    except (yaml.YAMLError, ValueError) as error:  # ValueError: a timestamp such as 2026-99-99
        raise config_error(name, [Problem(0, "", f"not valid YAML: {error}")]) from error
    finally:
        loader.dispose()


def _walk(node: yaml.Node, path: Path, lines: dict[Path, int], name: str, count: list[int]) -> None:
    count[0] += 1
    if count[0] > NODES_MAX:
        raise config_error(name, [Problem(0, "", f"more than {NODES_MAX} values")])
    if isinstance(node, yaml.MappingNode):
        for key_node, value_node in node.value:
            key: str | int = str(key_node.value)
            at = key_node.start_mark.line + 1
            if (*path, key) in lines:
                first = lines[(*path, key)]
                raise config_error(
                    name, [Problem(at, dotted((*path, key)), f"key given twice; first in line {first}")]
                )
            lines[(*path, key)] = at
            _walk(value_node, (*path, key), lines, name, count)
    elif isinstance(node, yaml.SequenceNode):
        for index, item in enumerate(node.value):
            lines[(*path, index)] = item.start_mark.line + 1
            _walk(item, (*path, index), lines, name, count)


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


def config_error(name: str, problems: list[Problem]) -> ConfigError:
    """All mistakes of a file as one typed error: a line of text for each, and the fields for programs."""
    return ConfigError(
        "\n".join(problem.text(name) for problem in problems),
        details={
            "file": name,
            "fields": [{"line": p.line, "field": p.field, "problem": p.problem} for p in problems],
        },
    )


def problems_of(
    error: ValidationError, source: YamlText, known: Mapping[Path, Collection[str]]
) -> list[Problem]:
    """Pydantic's findings with the lines of the text. `known` lists the keys of each section, for suggestions."""
    problems = []
    for finding in error.errors(include_url=False, include_context=False):
        path: Path = tuple(finding["loc"])
        if finding["type"] == "extra_forbidden":
            text = "unknown key" + did_you_mean(str(path[-1]), known.get(path[:-1], ()))
        else:
            text = finding["msg"].removeprefix("Value error, ").removeprefix("Assertion failed, ")
        problems.append(Problem(source.line(path), dotted(path), text))
    return sorted(problems, key=lambda problem: problem.line)
