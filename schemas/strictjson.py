"""JSON from outside, read strictly: what Python's parser lets through and no robot should act on is
an error.

Refused: NaN and infinities (also `1e999`), whole numbers beyond 64 bits and halves of surrogate
pairs (no wire could carry them on), an object that names a key twice, nesting deeper than
`DEPTH_MAX`, text beyond `max_chars`. Pure; knows no message.
"""

import json
import math
from typing import Any, NoReturn

from vram_arbiter.schemas.plain import JsonObject

DEPTH_MAX = 64
TEXT_MAX_CHARS = 65_536


def loads(text: str | bytes, *, max_chars: int = TEXT_MAX_CHARS) -> Any:
    """The value of a JSON text. Raises ValueError, which says what is wrong with it."""
    if len(text) > max_chars:
        raise ValueError(f"longer than {max_chars} characters")
    try:
        value = json.loads(
            text, parse_constant=_no_number, parse_float=_finite, object_pairs_hook=_no_key_twice
        )
    except RecursionError:
        raise ValueError("nested too deeply") from None
    check(value)
    return value


def check(value: Any) -> None:
    """The same rules for a value that was parsed elsewhere. Raises ValueError."""
    layer = [value]
    for _ in range(DEPTH_MAX + 1):
        below: list[Any] = []
        for item in layer:
            if isinstance(item, dict):
                below += [*item, *item.values()]
            elif isinstance(item, list | tuple):
                below += item
            elif isinstance(item, float) and not math.isfinite(item):
                raise ValueError(f"{item} is not a finite number")
            elif isinstance(item, int) and not -(1 << 63) <= item < 1 << 63:
                raise ValueError("a whole number has more than 64 bits")
            elif isinstance(item, str) and any("\ud800" <= letter <= "\udfff" for letter in item):
                raise ValueError("a text has half of a surrogate pair")
        if not below:
            return
        layer = below
    raise ValueError(f"nested deeper than {DEPTH_MAX} levels")


def _no_number(text: str) -> NoReturn:
    raise ValueError(f"{text} is not a finite number")


def _finite(text: str) -> float:
    number = float(text)
    if not math.isfinite(number):
        raise ValueError(f"{text} is too large for a number")
    return number


def _no_key_twice(pairs: list[tuple[str, Any]]) -> JsonObject:
    found = dict(pairs)
    if len(found) != len(pairs):
        names = [name for name, _ in pairs]
        raise ValueError(
            f"the key {next(name for name in names if names.count(name) > 1)!r} is given twice"
        )
    return found
