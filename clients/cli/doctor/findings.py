"""Findings of `vramctl doctor`, and how checks are run. Knows no check."""

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from enum import StrEnum
from typing import ClassVar, Final


class Severity(StrEnum):
    """How bad a finding is. `note`: worth knowing, not wrong. `unknown`: could not be examined."""

    OK = "ok"
    NOTE = "note"
    UNKNOWN = "unknown"
    WARNING = "warning"
    ERROR = "error"


WRONG: Final = frozenset({Severity.WARNING, Severity.ERROR})
"""Severities that make `vramctl doctor` exit with 1."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. `code` is stable: `CHECK.what`. `fix`: a command that resolves it."""

    WHOLE: ClassVar = True

    code: str
    severity: Severity
    found: str
    fix: str = ""


@dataclass(frozen=True, slots=True)
class Report:
    """All findings, in the order of the checks."""

    WHOLE: ClassVar = True

    endpoint: str
    findings: tuple[Finding, ...]


class CouldNotLook(Exception):
    """A check cannot be done; the text says why."""


type Checks[M] = Sequence[tuple[str, Callable[[M], Iterator[Finding]], str]]
"""(first part of the codes, check of a machine, what is said where it finds nothing)"""


def ok(code: str, found: str) -> Finding:
    return Finding(code, Severity.OK, found)


def note(code: str, found: str, fix: str = "") -> Finding:
    return Finding(code, Severity.NOTE, found, fix)


def warning(code: str, found: str, fix: str) -> Finding:
    return Finding(code, Severity.WARNING, found, fix)


def error(code: str, found: str, fix: str) -> Finding:
    return Finding(code, Severity.ERROR, found, fix)


def examine[M](machine: M, checks: Checks[M]) -> tuple[Finding, ...]:
    """Run the checks. One that cannot be done leaves a finding that says why, never nothing."""
    found: list[Finding] = []
    for name, check, sound in checks:
        try:
            found += list(check(machine)) or [ok(f"{name}.sound", sound)]
        except CouldNotLook as why:
            found.append(Finding(f"{name}.unknown", Severity.UNKNOWN, f"could not look: {why}"))
    return tuple(found)
