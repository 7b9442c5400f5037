"""Violations as the safety gate reports them: a text, and the check that found it.

Must not know a gate, a robot or a skill.
"""

from __future__ import annotations

from typing import Literal

type Check = Literal[
    "estop",
    "freshness",
    "form",
    "base_speed",
    "joint_range",
    "measured_speed",
    "effort",
    "joint_speed",
    "following_error",
    "tool_speed",
    "workspace",
    "no_go_zone",
    "skill",
]
"""Names of checks, a closed set; `skill`: the skill itself shortened its action."""


class Violation(str):
    """Text of a violation, with the check that found it."""

    __slots__ = ("check",)
    check: Check

    def __new__(cls, check: Check, text: str) -> Violation:
        made = super().__new__(cls, text)
        made.check = check
        return made


class SafetyViolation(Exception):
    """The one reason why nothing of an action is applied."""

    def __init__(self, check: Check, text: str) -> None:
        super().__init__(text)
        self.violation = Violation(check, text)
