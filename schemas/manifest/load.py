"""From the text of an `rskill.yaml` to a manifest, or to every finding with its line.

YAML is read with the safe loader only. Duplicate keys, which YAML parsers silently merge, are findings; so are texts that are
too large, nested too deeply, or grow through aliases.
"""

from collections.abc import Mapping
from pathlib import Path as FilePath
from typing import Any

import yaml
from pydantic import ValidationError

from schemas.manifest.kinds import KINDS, check_kind
from schemas.manifest.manifest import RSkillManifest
from schemas.manifest.problems import ManifestError, Path, Problem, from_validation_error
from schemas.manifest.vocabulary import Kind

TEXT_MAX_BYTES = 1 << 20
VALUES_MAX = 100_000  # after aliases are expanded


def load_manifest(path: str | FilePath) -> RSkillManifest:
    """Read one file. Raises ManifestError with every finding, also if it cannot be read."""
    source = str(path)
    try:
        with open(path, "rb") as file:
            content = file.read(TEXT_MAX_BYTES + 1)
    except OSError as error:
        raise ManifestError(source, [Problem((), f"cannot be read: {error.strerror or error}")]) from error
    return parse_manifest(content, source)


def parse_manifest(content: str | bytes, source: str = "rskill.yaml") -> RSkillManifest:
    """Check the text of a manifest. Raises ManifestError with every finding; `source` names the text in messages."""
    try:
        data, root = _read_yaml(content)
    except _Unreadable as error:
        raise ManifestError(source, error.problems) from error
    try:
        return RSkillManifest.model_validate(data)
    except ValidationError as error:
        problems = _with_kind_rules(from_validation_error(error, RSkillManifest, data), data)
        located = [Problem(problem.path, problem.message, _line(root, problem.path)) for problem in problems]
        raise ManifestError(source, sorted(located, key=lambda problem: problem.line or 0)) from error


def _with_kind_rules(problems: list[Problem], data: Mapping[str, Any]) -> list[Problem]:
    """Add what the kind demands: pydantic stops before that rule as soon as any single field is wrong."""
    kind = data.get("kind")
    if kind not in KINDS:
        return problems
    known = {problem.path for problem in problems}
    return problems + [problem for problem in check_kind(Kind(kind), data) if problem.path not in known]


class _Unreadable(Exception):
    def __init__(self, *problems: Problem) -> None:
        self.problems = problems


def _read_yaml(content: str | bytes) -> tuple[dict[str, Any], yaml.Node]:
    """The mapping and its node tree, which knows the lines."""
    if len(content) > TEXT_MAX_BYTES:
        raise _Unreadable(Problem((), f"is larger than {TEXT_MAX_BYTES} bytes"))
    try:
        text = content.decode("utf-8") if isinstance(content, bytes) else content
    except UnicodeDecodeError as error:
        raise _Unreadable(Problem((), f"is not UTF-8 text: {error.reason} at byte {error.start}")) from error
    loader = None
    try:
        loader = yaml.SafeLoader(text)
        root = loader.get_single_node()
        if root is None:
            raise _Unreadable(Problem((), "is empty; it must be a mapping of fields"))
        if not isinstance(root, yaml.MappingNode):
            raise _Unreadable(
                Problem((), "must be a mapping of fields, not a list or a single value", _line(root, ()))
            )
        duplicates = _survey(root)
        if duplicates:
            raise _Unreadable(*duplicates)
        data = loader.construct_document(root)
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark
        raise _Unreadable(
            Problem((), f"is not YAML: {error.problem or error.context}", mark.line + 1 if mark else None)
        ) from error
    except (
        yaml.YAMLError,
        ValueError,
    ) as error:  # ValueError: a date or a number that looks right and is not
        raise _Unreadable(Problem((), f"is not YAML: {' '.join(str(error).split())}")) from error
    except RecursionError as error:
        raise _Unreadable(Problem((), "is nested too deeply")) from error
    finally:
        if loader is not None:
            loader.dispose()
    wrong = [key for key in data if not isinstance(key, str)]
    if wrong:
        raise _Unreadable(*(Problem((), f"field names must be texts, not {key!r}") for key in wrong))
    return data, root


def _survey(root: yaml.Node) -> list[Problem]:
    """Duplicate keys below a node. Raises _Unreadable for values that contain themselves or multiply through aliases."""
    duplicates: list[Problem] = []
    sizes: dict[int, int] = {}
    open_nodes: set[int] = set()

    def size(node: yaml.Node, path: Path) -> int:
        if id(node) in open_nodes:
            raise _Unreadable(Problem(path, "contains itself", node.start_mark.line + 1))
        if id(node) in sizes:
            return sizes[id(node)]
        open_nodes.add(id(node))
        total = 1
        if isinstance(node, yaml.SequenceNode):
            total += sum(size(child, (*path, index)) for index, child in enumerate(node.value))
        elif isinstance(node, yaml.MappingNode):
            seen: dict[str, int] = {}
            for key, child in node.value:
                name, line = str(key.value), key.start_mark.line + 1
                if isinstance(key, yaml.ScalarNode) and name in seen:
                    duplicates.append(
                        Problem((*path, name), f"is given twice, first in line {seen[name]}", line)
                    )
                seen.setdefault(name, line)
                total += size(child, (*path, name))
        open_nodes.discard(id(node))
        sizes[id(node)] = total
        if total > VALUES_MAX:
            raise _Unreadable(Problem((), f"has more than {VALUES_MAX} values"))
        return total

    size(root, ())
    return duplicates


def _line(root: yaml.Node, path: Path) -> int:
    """Line of the value at a path, or of the nearest thing around it that exists."""
    node, line = root, root.start_mark.line + 1
    for part in path:
        if isinstance(node, yaml.MappingNode):
            found = [(key, child) for key, child in node.value if key.value == part]
            if not found:
                return line
            line, node = found[0][0].start_mark.line + 1, found[0][1]
        elif isinstance(node, yaml.SequenceNode) and isinstance(part, int) and part < len(node.value):
            node = node.value[part]
            line = node.start_mark.line + 1
        else:
            return line
    return line
