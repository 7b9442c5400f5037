"""One step of a plan, and the steps that write, link and remove files.

A file that was changed after it was installed is never overwritten and never removed.
"""

import contextlib
import difflib
import os
import shutil
import tempfile
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

from vram_arbiter.clients.cli.installation.contents import Contents
from vram_arbiter.clients.cli.installation.record import Record, digest
from vram_arbiter.clients.cli.installation.site import Site


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
        return self.perform is not None and self.verb not in ("same", "gone")


@dataclass(frozen=True, slots=True)
class Files:
    """Steps for the files and links of one installation; they keep `record` up to date."""

    site: Site
    record: Record

    def install(self, wanted: Contents) -> list[Step]:
        """Return the steps that bring the machine's files to what is wanted."""
        needed = dict(wanted.files)
        steps = []
        for path, text in wanted.files.items():
            step = self._file(path, text)
            if step.verb == "keep":
                needed[_beside(path)] = text
            steps.append(step)
        steps += [self._link(path, target) for path, target in wanted.links.items()]
        obsolete = [path for path in self.record.files if path not in needed]
        steps += [self._removal(path, edited=False) for path in obsolete]
        return steps + [
            self._obsolete_link(path) for path in self.record.links if path not in wanted.links
        ]

    def remove(self, *, edited: bool) -> list[Step]:
        """Return the steps that remove what was installed; with `edited` what was changed too."""
        steps = [self._removal(path, edited=edited) for path in self.record.files]
        return steps + [self._obsolete_link(path) for path in self.record.links]

    def remove_folders(self) -> None:
        """Remove the folders that were made for files and are empty."""
        for folder in sorted(self.record.folders, reverse=True):
            with contextlib.suppress(OSError):
                self.site.at(folder).rmdir()

    def write(self, path: Path, content: bytes) -> None:
        """Write a file at once or not at all, mode 0644, and the folders above it."""
        place = self.site.at(path)
        self._make_parents(path)
        handle, temporary = tempfile.mkstemp(dir=place.parent, prefix=f".{place.name}.")
        try:
            with os.fdopen(handle, "wb") as file:
                os.fchmod(handle, 0o644)
                file.write(content)
                file.flush()
                os.fsync(handle)
            os.replace(temporary, place)
        except BaseException:
            os.unlink(temporary)
            raise

    def _file(self, path: Path, text: str) -> Step:
        content = text.encode()
        there = self._content(path)
        recorded = self.record.files.get(path)
        if there is None and not os.path.lexists(self.site.at(path)):
            return Step("new", str(path), perform=partial(self._install, path, content))
        if there == content:
            return Step("same", str(path), perform=partial(self._note, path, content))
        changes = [] if there is None else _diff(there, text)
        if there is not None and recorded == digest(there):
            return Step("replace", str(path), changes, partial(self._install, path, content))
        if recorded == digest(content):
            return Step("keep", f"{path}: changed by hand")
        says = f"{path}: changed by hand; the new text goes to {_beside(path).name}"
        return Step("keep", says, changes, partial(self._put_beside, path, content))

    def _link(self, path: Path, target: str) -> Step:
        says = f"{path} -> {target}"
        there = self._target(path)
        if there is None and not os.path.lexists(self.site.at(path)):
            return Step("new", says, perform=partial(self._make_link, path, target))
        if there == target:
            note = partial(self.record.links.__setitem__, path, target)
            return Step("same", says, perform=note)
        if there is not None and there == self.record.links.get(path):
            return Step("replace", says, perform=partial(self._make_link, path, target))
        return Step("keep", f"{path}: not installed by vramctl; {target} is not linked")

    def _removal(self, path: Path, *, edited: bool) -> Step:
        there = self._content(path)
        perform = partial(self._remove, path)
        if there is None and not os.path.lexists(self.site.at(path)):
            return Step("gone", str(path), perform=perform)
        if edited or (there is not None and digest(there) == self.record.files[path]):
            return Step("remove", str(path), perform=perform)
        return Step("keep", f"{path}: changed by hand", perform=partial(self._forget, path))

    def _obsolete_link(self, path: Path) -> Step:
        there = self._target(path)
        if there == self.record.links[path]:
            return Step("remove", str(path), perform=partial(self._remove, path))
        verb = "keep" if os.path.lexists(self.site.at(path)) else "gone"
        return Step(verb, f"{path}: no longer the link", perform=partial(self._forget, path))

    def _content(self, path: Path) -> bytes | None:
        """Return what a regular file holds; None for anything else, a link too."""
        place = self.site.at(path)
        return place.read_bytes() if place.is_file() and not place.is_symlink() else None

    def _target(self, path: Path) -> str | None:
        place = self.site.at(path)
        return os.readlink(place) if place.is_symlink() else None

    def _install(self, path: Path, content: bytes) -> None:
        self.write(path, content)
        self._note(path, content)

    def _put_beside(self, path: Path, content: bytes) -> None:
        """Offer a new text once: it is not offered again after its file was moved or removed."""
        self._install(_beside(path), content)
        self._note(path, content)

    def _note(self, path: Path, content: bytes) -> None:
        self.record.files[path] = digest(content)

    def _make_link(self, path: Path, target: str) -> None:
        self._make_parents(path)
        place = self.site.at(path)
        place.unlink(missing_ok=True)
        place.symlink_to(target)
        self.record.links[path] = target

    def _make_parents(self, path: Path) -> None:
        for folder in reversed(path.parents):
            place = self.site.folder(folder)
            if not place.is_dir():
                place.mkdir(mode=0o755)
                if folder not in self.record.folders:
                    self.record.folders.append(folder)

    def _remove(self, path: Path) -> None:
        self.site.at(path).unlink(missing_ok=True)
        self._forget(path)

    def _forget(self, path: Path) -> None:
        self.record.files.pop(path, None)
        self.record.links.pop(path, None)


def store(files: Files) -> None:
    """Write the record of an installation, and the folder that it is in."""
    content = files.record.model_dump_json(indent=2) + "\n"
    files.write(files.site.record, content.encode())


def remove_tree(folder: Path) -> None:
    """Remove a folder with all that is in it; a link is removed, not what it leads to."""
    if folder.is_symlink():
        folder.unlink()
    else:
        shutil.rmtree(folder)


def _beside(path: Path) -> Path:
    return path.with_name(f"{path.name}.new")


def _diff(before: bytes, after: str) -> list[str]:
    old = before.decode("utf-8", "replace").splitlines()
    lines = list(difflib.unified_diff(old, after.splitlines(), lineterm="", n=1))
    return lines[2:]  # without the names
