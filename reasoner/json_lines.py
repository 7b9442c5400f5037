"""A file to which lines of JSON are appended."""

import logging
from pathlib import Path
from typing import IO

from pydantic import BaseModel

from vram_arbiter.schemas.errors import ConfigError

log = logging.getLogger(__name__)


class JsonLines:
    """Appends records to `path`, each written at once; without a path nothing is written.

    `option` names the file in errors. Raises ConfigError for a file that cannot be written; a
    later failure, such as a full disk, is logged and stops no robot.
    """

    def __init__(self, path: Path | None, option: str) -> None:
        self._option = option
        self._file: IO[str] | None = None
        if path is not None:
            try:
                self._file = path.open("a", encoding="utf-8", errors="backslashreplace")
            except OSError as error:
                raise ConfigError(
                    f"{option} {path} cannot be written: {error.strerror}",
                    hint="name a file in a folder of your own",
                ) from error

    def add(self, record: BaseModel, *, without_none: bool = False) -> None:
        """Write one record; `without_none` leaves out the fields that are None."""
        if self._file is None:
            return
        try:
            self._file.write(record.model_dump_json(exclude_none=without_none) + "\n")
            self._file.flush()  # a reasoner that is killed has said this much
        except OSError as error:
            log.error("%s misses a line: %s", self._option, error)

    def close(self) -> None:
        """Close the file; nothing is written from then on."""
        if self._file is not None:
            file, self._file = self._file, None
            try:
                file.close()
            except OSError as error:  # what could not be written before
                log.error("%s is not complete: %s", self._option, error)
