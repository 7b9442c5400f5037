"""Files that are written whole or not at all."""

import os
import tempfile
from pathlib import Path


def replace(place: Path, text: str, mode: int = 0o644) -> None:
    """Write a file at once or not at all. Raises OSError."""
    handle, temporary = tempfile.mkstemp(dir=place.parent, prefix=f".{place.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", errors="surrogateescape") as file:
            os.fchmod(handle, mode)
            file.write(text)
            file.flush()
            os.fsync(handle)
        os.replace(temporary, place)
    except BaseException:
        os.unlink(temporary)
        raise
