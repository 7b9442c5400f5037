"""Reading and writing byte sizes, free of pydantic so that a command line that only prints starts
fast."""

import re

_UNITS = {
    "": 1, "b": 1,
    "k": 10**3, "kb": 10**3, "m": 10**6, "mb": 10**6, "g": 10**9, "gb": 10**9, "t": 10**12,
    "tb": 10**12,
    "ki": 2**10, "kib": 2**10, "mi": 2**20, "mib": 2**20, "gi": 2**30, "gib": 2**30, "ti": 2**40,
    "tib": 2**40,
}  # fmt: skip
MAX_BYTES = 1 << 63
SHOWN_CHARS = 40
_SIZE = re.compile(r"\s*([0-9]+(?:\.[0-9]+)?)\s*([A-Za-z]*)\s*")


def parse_bytes(text: str | int) -> int:
    """Read `8GiB`, `5.3GB`, `450MiB` or a plain count of bytes. Raises ValueError with the accepted
    forms."""
    if isinstance(text, bool) or not isinstance(text, int | str):
        raise ValueError(f"a size is a number of bytes or a text such as 8GiB, not {text!r}")
    if isinstance(text, int):
        return _bounded(text, str(text))
    match = _SIZE.fullmatch(text)
    if match is None or match[2].lower() not in _UNITS:
        raise ValueError(
            f"not a size: {text!r}; write bytes or 8GiB (1024-based), 5.3GB (1000-based), 450MiB"
        )
    return _bounded(float(match[1]) * _UNITS[match[2].lower()], text)


def _bounded(size: float, text: str) -> int:
    if not 0 <= size < MAX_BYTES:
        raise ValueError(f"expected a size of 0 to 8 EiB, got {text[:SHOWN_CHARS]}")
    return round(size)


def parse_need(text: str) -> int:
    """Read the size of a lease, `5GiB` or `5.3GB`. Raises ValueError, also for a number without a
    unit, which is rarely meant as bytes, and for 0."""
    size = parse_bytes(text)
    if text.strip()[-1].isdecimal() or not size:
        raise ValueError(f"expected a size with its unit, such as 5GiB or 450MiB, got {text!r}")
    return size


def format_bytes(count: int) -> str:
    """Binary units with two decimals at most, e.g. `4.94 GiB`, `450 MiB`, `0 B`."""
    sign, size = ("-", -count) if count < 0 else ("", count)
    for factor, unit in ((2**30, "GiB"), (2**20, "MiB"), (2**10, "KiB")):
        if size >= factor:
            return f"{sign}{size / factor:.2f}".rstrip("0").rstrip(".") + f" {unit}"
    return f"{sign}{size} B"
