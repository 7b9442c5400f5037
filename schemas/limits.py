"""Limits of a field, stated with its type: `Annotated[int, Limits(ge=0)]`.

pydantic applies them where a plain value becomes a message; a dataclass that carries them stays
free of pydantic, so that the sans-IO core may hold it. Standard library only.
"""

from collections.abc import Callable
from typing import Annotated, Any, Final

from vram_arbiter.schemas import defaults as d

type _Schema = dict[str, object]


class Limits:
    """Limits by the names of pydantic's core schemas: ge, gt, le, lt, min_length, max_length,
    pattern, allow_inf_nan, fail_fast."""

    def __init__(self, **limits: float | str | bool) -> None:
        self._limits = limits

    def __get_pydantic_core_schema__(
        self, source: object, handler: Callable[[object], _Schema]
    ) -> _Schema:
        return {**handler(source), **self._limits}


class AsPair:
    """A named tuple of two whole numbers that is a list of two in its plain form."""

    def __get_pydantic_core_schema__(self, source: Any, handler: Any) -> _Schema:
        pair = handler.generate_schema(tuple[int, int])
        make = {"type": "no-info", "function": source._make}
        return {"type": "function-after", "function": make, "schema": pair}


STRICT: Final = {"extra": "forbid"}
"""`__pydantic_config__` of a dataclass that refuses unknown keys."""
NAME: Final = Limits(min_length=1, max_length=d.NAME_MAX_CHARS, pattern=r"^[^\x00-\x1f\x7f]+$")
Name = Annotated[str, NAME]
Bytes = Annotated[int, Limits(ge=0, le=1 << 50)]
Seconds = Annotated[float, Limits(ge=0, le=86_400 * 365, allow_inf_nan=False)]
UNIT_NAME: Final = r"^[A-Za-z0-9:_.\\@][A-Za-z0-9:_.\\@-]{0,254}$"
CONTAINER_NAME: Final = "^[A-Za-z0-9][A-Za-z0-9_.-]{0,254}$"
"""Names that may be arguments of systemctl, and of podman and docker."""
