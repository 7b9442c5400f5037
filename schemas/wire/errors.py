"""An error as it crosses the wire. Standard library only."""

from dataclasses import dataclass, field
from typing import ClassVar, dataclass_transform

from vram_arbiter.schemas.plain import JsonMap


@dataclass_transform(frozen_default=True)
class Refusal:
    """Base of the values of one kind of refusal, as the engine makes them: typed fields and no
    words. A subclass is a dataclass, frozen for the type checker (as `Tagged`).

    `code` is the wire code. `arbiter.rpc.words` makes an `ErrorView` of it, with the fields as
    `details`.
    """

    code: ClassVar[str]

    def __init_subclass__(cls, *, code: str = "") -> None:
        if code:
            cls.code = code
        dataclass()(cls)

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
    details: JsonMap | Refusal = field(default_factory=dict)
