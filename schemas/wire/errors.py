"""An error as it crosses the wire. Standard library only."""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Any, ClassVar


class Refusal:
    """Base of the values of one kind of refusal, as the engine makes them: typed fields and no
    words.

    `code` is the wire code. `arbiter.rpc.words` makes an `ErrorView` of it, with the fields as
    `details`.
    """

    __slots__ = ()
    code: ClassVar[str]

    @classmethod
    def __get_pydantic_core_schema__(cls, *_: object) -> dict[str, str]:
        """A map, for the export of JSON Schemas."""
        return {"type": "dict"}

    def view(self) -> "ErrorView":
        """Return the error without words."""
        return ErrorView(self.code, details=self)


@dataclass(frozen=True, slots=True)
class ErrorView:
    """A typed error: `code` is one of `schemas.errors.CODES`, `details` its values, and words for
    people."""

    WHOLE: ClassVar = True

    code: str
    message: str = ""
    hint: str = ""
    details: Mapping[str, Any] | Refusal = field(default_factory=dict)
