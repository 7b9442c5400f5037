"""An error as it crosses the wire. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any


@dataclass(frozen=True, slots=True)
class ErrorView:
    """A typed error: `code` is one of `schemas.errors.CODES`, `details` its values, and words for people."""

    code: str
    message: str = ""
    hint: str = ""
    details: Mapping[str, Any] = field(default_factory=dict)
