"""From the text of an `rskill.yaml` to a manifest, or to every finding with its line.

`schemas.yamltext` reads the YAML; this module adds what a manifest asks for.
"""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path as FilePath

from pydantic import ValidationError

from vram_arbiter.schemas.errors import ConfigError, ManifestInvalid
from vram_arbiter.schemas.findings import Problem, problems_of
from vram_arbiter.schemas.manifest.kinds import KINDS, check_kind
from vram_arbiter.schemas.manifest.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Kind
from vram_arbiter.schemas.yamltext import parse_yaml, read_text


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


def load_manifest(path: str | FilePath) -> RSkillManifest:
    """Read one file. Raises ManifestError with every finding, also if it cannot be read."""
    source = str(path)
    try:
        text = read_text(FilePath(path))
    except ConfigError as error:
        raise _unreadable(source, error) from error
    return parse_manifest(text, source)


def parse_manifest(content: str | bytes, source: str = "rskill.yaml") -> RSkillManifest:
    """Check the text of a manifest. Raises ManifestError with every finding; `source` names the
    text in messages."""
    try:
        document = parse_yaml(content, source)
    except ConfigError as error:
        raise _unreadable(source, error) from error
    data = document.data
    try:
        return RSkillManifest.model_validate(data)
    except ValidationError as error:
        problems = _with_kind_rules(problems_of(error, RSkillManifest, data), data)
        located = [replace(problem, line=document.line(problem.path)) for problem in problems]
        raise ManifestError(
            source, sorted(located, key=lambda problem: problem.line or 0)
        ) from error


def _with_kind_rules(problems: list[Problem], data: object) -> list[Problem]:
    """Add what the kind demands: pydantic stops before that rule as soon as any single field is
    wrong."""
    kind = data.get("kind") if isinstance(data, Mapping) else None
    if not isinstance(data, Mapping) or kind not in KINDS:
        return problems
    known = {problem.path for problem in problems}
    return problems + [
        problem for problem in check_kind(Kind(kind), data) if problem.path not in known
    ]


def _unreadable(source: str, error: ConfigError) -> ManifestError:
    """The same findings as a manifest's."""
    fields = error.details.get("fields")
    if fields is None:
        return ManifestError(source, [Problem((), error.message.removeprefix(f"{source} "))])
    return ManifestError(
        source,
        [
            Problem(
                (item["field"],) if item["field"] else (),
                item["problem"],
                item["line"] or None,
                item["column"] or None,
            )
            for item in fields
        ],
    )
