"""Files that a program writes behind its work."""

import os
from pathlib import Path

from vram_arbiter.schemas.errors import ConfigError


def check_output(flag: str, path: Path | None) -> None:
    """Before a run, not behind it: whether its file can be written. Makes the folder, touches no
    file. Raises ConfigError."""
    if path is None:
        return
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"{flag} {path} cannot be written: {error}") from error
    if path.is_dir() or not os.access(path if path.exists() else path.parent, os.W_OK):
        raise ConfigError(
            f"{flag} {path} cannot be written", hint="name a file in a folder of your own"
        )
