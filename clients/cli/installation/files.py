"""The record of an installation, and the steps that bring files to what is wanted or remove them.

A link is a file whose text is its target. A file that was changed after it was installed is never
overwritten, and removed by a purge only.
"""

import contextlib
import difflib
import hashlib
import os
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from pydantic import BaseModel, ConfigDict, ValidationError

from vram_arbiter.clients.cli import files
from vram_arbiter.clients.cli.installation.environment import writable_by_others
from vram_arbiter.clients.cli.installation.site import GROUP, LINK, Site
from vram_arbiter.schemas.errors import ConfigError

QUIET: Final = ("same", "gone", "keep")
"""Words of steps after which the machine is as before."""


class Installed(BaseModel):
    """The file `installed.json`: what was put on the machine."""

    model_config = ConfigDict(extra="ignore")  # earlier versions noted more

    version: str = ""
    prefix: Path = Path("/")
    group: str = GROUP
    operators: list[str] = []
    files: dict[Path, str] = {}
    """Path → SHA-256 of what was written, not of what is there now."""
    folders: list[Path] = []
    """Made for a file; removed if they are empty."""
    started: bool = False
    """The arbiter was enabled and started, once."""


@dataclass(frozen=True, slots=True)
class Step:
    """One line of a plan. `perform` None: nothing to do, worth showing."""

    verb: str
    what: str
    detail: Sequence[str] = ()
    perform: Callable[[], object] | None = None

    @property
    def changes(self) -> bool:
        """Whether the machine is changed, not only the record."""
        return self.perform is not None and self.verb not in QUIET


def load(site: Site) -> Installed | None:
    """Return the record of the last installation, None without one.

    Raises ConfigError for a file that this version did not write, or that another user could have.
    """
    path = site.at(site.record)
    try:
        with open(os.open(path, os.O_RDONLY | os.O_NOFOLLOW | os.O_CLOEXEC), "rb") as file:
            problem = writable_by_others(os.fstat(file.fileno())) if os.getuid() == 0 else ""
            if problem:
                raise ConfigError(f"{path} {problem}; it says what root removes", hint="check it")
            return Installed.model_validate_json(file.read())
    except FileNotFoundError:
        return None
    except OSError as error:
        raise ConfigError(f"{path}: {error.strerror}") from error
    except ValidationError as error:
        problem = error.errors(include_url=False)[0]["msg"]
        raise ConfigError(
            f"{path} is not the record of an installation: {problem}",
            hint="move it away; the next installation takes over the files that are as it would "
            "write them",
        ) from error


@dataclass(frozen=True, slots=True)
class Files:
    """Steps for the files of one installation; they keep `record` up to date."""

    site: Site
    record: Installed

    def install(self, wanted: Mapping[Path, str]) -> list[Step]:
        """Return the steps that bring the machine's files to what is wanted."""
        steps = [self._file(path, text) for path, text in wanted.items()]
        obsolete = [path for path in self.record.files if path not in wanted]
        return [*steps, *(self._removal(path, purge=False) for path in obsolete)]

    def remove(self, *, purge: bool) -> list[Step]:
        """Return the steps that remove what was installed; a purge removes what was changed too."""
        return [self._removal(path, purge=purge) for path in self.record.files]

    def store(self) -> None:
        """Write the record, and the folder that it is in."""
        self._write(self.site.record, self.record.model_dump_json(indent=2) + "\n")

    def remove_folders(self) -> None:
        """Remove the folders that were made for files and are empty."""
        for folder in sorted(self.record.folders, reverse=True):
            with contextlib.suppress(OSError):
                self.site.at(folder).rmdir()

    def _file(self, path: Path, text: str) -> Step:
        there = self.site.read(path)
        put = partial(self._put, path, text)
        if there is None:
            return Step("new", str(path), perform=put)
        if there == text:
            return Step("same", str(path), perform=partial(self._note, path, text))
        changes, written = _diff(there, text), self.record.files.get(path)
        if written == _digest(there):
            return Step("replace", str(path), changes, put)
        if written in (None, _digest(text)):
            return Step("keep", f"{path}: changed by hand")
        return Step("keep", f"{path}: changed by hand; remove it to get this version", changes)

    def _removal(self, path: Path, *, purge: bool) -> Step:
        there = self.site.read(path)
        if there is None:
            return Step("gone", str(path), perform=partial(self._remove, path))
        if purge or _digest(there) == self.record.files[path]:
            return Step("remove", str(path), perform=partial(self._remove, path))
        forget = partial(self.record.files.pop, path, None)
        return Step("keep", f"{path}: changed by hand", perform=forget)

    def _put(self, path: Path, text: str) -> None:
        self._write(path, text)
        self._note(path, text)

    def _write(self, path: Path, text: str) -> None:
        for folder in reversed(path.parents):
            place = self.site.folder(folder)
            if not place.is_dir():
                place.mkdir(mode=0o755)
                self.record.folders.append(folder)
        place = self.site.at(path)
        if text.startswith(LINK):
            place.unlink(missing_ok=True)
            place.symlink_to(text.removeprefix(LINK))
        else:
            files.replace(place, text)

    def _note(self, path: Path, text: str) -> None:
        self.record.files[path] = _digest(text)

    def _remove(self, path: Path) -> None:
        self.site.at(path).unlink(missing_ok=True)
        self.record.files.pop(path, None)


def _digest(text: str) -> str:
    return hashlib.sha256(text.encode(errors="surrogateescape")).hexdigest()


def _diff(before: str, after: str) -> list[str]:
    lines = difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=1)
    return list(lines)[2:]  # without the names
