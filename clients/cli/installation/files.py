"""The record of an installation, and the steps that bring files to what is wanted or remove them.

A link is a file whose text is its target. A file that was changed after it was installed is never
overwritten, and removed by a purge only.
"""

import contextlib
import hashlib
import os
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from pydantic import BaseModel, ValidationError

from vram_arbiter.clients.cli import files
from vram_arbiter.clients.cli.installation.environment import writable_by_others
from vram_arbiter.clients.cli.installation.site import LINK, Site
from vram_arbiter.schemas.errors import ConfigError


class Installed(BaseModel):
    """The file `installed.json`: what was put on the machine."""

    files: dict[Path, str] = {}
    """Path → SHA-256 of what was written, not of what is there now."""
    started: bool = False
    """The arbiter was enabled and started, once."""


@dataclass(frozen=True, slots=True)
class Step:
    """One line of a plan. `perform` None: nothing to do, worth showing."""

    verb: str
    what: str
    perform: Callable[[], object] | None = None


def load(site: Site) -> Installed:
    """Return the record of the last installation, an empty one without.

    Raises ConfigError for a file that this version did not write, or that another user could have.
    """
    path = site.at(site.record)
    try:
        if os.getuid() == 0 and (problem := writable_by_others(path.lstat())):
            raise ConfigError(f"{path} {problem}; it says what root removes", hint="check it")
        return Installed.model_validate_json(path.read_bytes())
    except FileNotFoundError:
        return Installed()
    except (OSError, ValidationError) as error:
        raise ConfigError(
            f"{path} is not the record of an installation: {error}", hint="move it away"
        ) from error


@dataclass(frozen=True, slots=True)
class Files:
    """Steps for the files of one installation; they keep `record` up to date."""

    site: Site
    record: Installed

    def plan(self, wanted: Mapping[Path, str], *, purge: bool = False) -> list[Step]:
        """Return the steps that bring the machine's files to what is wanted; a purge removes what
        was changed by hand too."""
        steps = [self._file(path, text) for path, text in wanted.items()]
        obsolete = [path for path in self.record.files if path not in wanted]
        return [*steps, *(self._removal(path, purge=purge) for path in obsolete)]

    def store(self) -> None:
        """Write the record, or remove that of nothing."""
        if self.record.files:
            self._write(self.site.record, self.record.model_dump_json(indent=2) + "\n")
        else:
            _unlink(self.site.at(self.site.record))

    def _file(self, path: Path, text: str) -> Step:
        there, written = self.site.read(path), self.record.files.get(path)
        put = partial(self._put, path, text)
        if there is None:
            return Step("new", str(path), put)
        if there == text:
            self.record.files[path] = _digest(text)
            return Step("same", str(path))
        if written == _digest(there):
            return Step("replace", str(path), put)
        return Step("keep", f"{path}: changed by hand; remove it to get this version")

    def _removal(self, path: Path, *, purge: bool) -> Step:
        there = self.site.read(path)
        if there is None or purge or _digest(there) == self.record.files[path]:
            return Step("remove", str(path), partial(self._remove, path))
        return Step("keep", f"{path}: changed by hand")

    def _put(self, path: Path, text: str) -> None:
        self._write(path, text)
        self.record.files[path] = _digest(text)

    def _write(self, path: Path, text: str) -> None:
        self.site.folder(path.parent).mkdir(mode=0o755, parents=True, exist_ok=True)
        place = self.site.at(path)
        if text.startswith(LINK):
            place.unlink(missing_ok=True)
            place.symlink_to(text.removeprefix(LINK))
        else:
            files.replace(place, text)

    def _remove(self, path: Path) -> None:
        _unlink(self.site.at(path))
        self.record.files.pop(path, None)


def _unlink(place: Path) -> None:
    place.unlink(missing_ok=True)
    with contextlib.suppress(OSError):  # a folder that has other files
        os.removedirs(place.parent)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()
