"""What `vramctl hooks` keeps between two runs: how far it read, and what it has not delivered.

One JSON file, replaced as a whole, in a folder of this user's own; one program at a time has it.
"""

import contextlib
import json
import os
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import ClassVar, Final

from vram_arbiter.clients.hooks.events import Delivery
from vram_arbiter.schemas import strictjson
from vram_arbiter.schemas.codec import CodecError, from_map, to_map
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder

FILE_MAX_CHARS: Final = 1 << 27


@dataclass(frozen=True, slots=True)
class Saved:
    """`read`: number of the last event that was read, by numbering; the newest numbering is last.
    `pending`: deliveries that did not end."""

    WHOLE: ClassVar = True

    read: Mapping[str, int] = field(default_factory=dict)
    pending: Sequence[Delivery] = ()


class StateFile:
    """`open` once, then `load` and `save`; `close` at the end."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._lock = LockFile(path.with_name(f"{path.name}.lock"), str(path), "vramctl hooks")

    def open(self) -> None:
        """Make the folder and lock the file. Raises ConfigError, AlreadyRunning."""
        with contextlib.suppress(FileExistsError):
            self._path.parent.parent.mkdir(mode=0o700, parents=True, exist_ok=True)
        private_folder(self._path.parent)
        self._lock.acquire()

    def close(self) -> None:
        self._lock.release()

    def load(self) -> Saved:
        """Return what was saved last; nothing at the first start. Raises ConfigError."""
        try:
            text = self._path.read_text()
        except FileNotFoundError:
            return Saved()
        except (OSError, ValueError) as error:
            raise self._damaged(error) from error
        try:
            return from_map(Saved, strictjson.loads(text, max_chars=FILE_MAX_CHARS), strict=True)
        except (ValueError, CodecError) as error:
            raise self._damaged(error) from error

    def save(self, saved: Saved) -> None:
        """Replace the file. Raises OSError."""
        new = self._path.with_name(f"{self._path.name}.new")
        descriptor = os.open(new, os.O_WRONLY | os.O_CREAT | os.O_TRUNC | os.O_CLOEXEC, 0o600)
        with open(descriptor, "w") as file:
            json.dump(to_map(saved), file)
        os.replace(new, self._path)

    def _damaged(self, error: Exception) -> ConfigError:
        return ConfigError(
            f"{self._path} cannot be read: {error}",
            hint="remove it; hooks then begin with new events",
        )
