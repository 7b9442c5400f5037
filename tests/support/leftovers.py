"""Folders of one test run: its own, and empty at the end.

A pytest plugin. Whatever the tests and their programs leave in TMPDIR fails the run, with its name.
Each worker has a runtime folder of its own: a program that a test runs without naming sockets once
met the developer's runner at the default ones.
"""

import os
import shutil
import tempfile
from fnmatch import fnmatch
from pathlib import Path

import pytest

from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE

_KEY = pytest.StashKey[Path]()
_FAILED = pytest.StashKey[bool]()
OF_TESTS = "p"
"""Folder of `tmp_path`."""
RUNTIME = "run-"
KEPT = (OF_TESTS, f"{RUNTIME}*", "torchinductor_*")
"""What may lie there at the end: `tmp_path`, runtime folders, and the cache of torch's compiler."""


def _is_worker() -> bool:
    return "PYTEST_XDIST_WORKER" in os.environ


@pytest.hookimpl(tryfirst=True)
def pytest_configure(config: pytest.Config) -> None:
    """Give the run, its workers and its programs a temporary folder of their own."""
    if not _is_worker():
        # Open: some programs become another user.
        made = Path(tempfile.mkdtemp(prefix="t"))
        made.chmod(0o1777)
        config.stash[_KEY] = made
        os.environ["TMPDIR"] = tempfile.tempdir = str(made)
        # Short: the path of a socket in `tmp_path` holds 107 bytes.
        config.option.basetemp = config.option.basetemp or str(made / OF_TESTS)
    worker = os.environ.get("PYTEST_XDIST_WORKER", "")
    os.environ[RUNTIME_VARIABLE] = f"{tempfile.gettempdir()}/{RUNTIME}{worker}"


@pytest.hookimpl(trylast=True)
def pytest_sessionfinish(session: pytest.Session) -> None:
    """Fail the run for what is left."""
    folder = session.config.stash.get(_KEY, None)
    if folder is not None and (left := leftovers(folder)):
        writer = session.config.get_terminal_writer()
        writer.line(f"\nleft in the temporary folder: {', '.join(left)}", red=True)
        session.exitstatus = session.exitstatus or pytest.ExitCode.TESTS_FAILED
    if folder is not None and session.exitstatus == pytest.ExitCode.TESTS_FAILED:
        session.config.stash[_FAILED] = True
        session.config.get_terminal_writer().line(f"\ntemporary files of this run: {folder}")


def pytest_unconfigure(config: pytest.Config) -> None:
    """Remove the folder; after a failed run it stays, to be looked at."""
    folder = config.stash.get(_KEY, None)
    if folder is not None and not config.stash.get(_FAILED, False):
        shutil.rmtree(folder, ignore_errors=True)


def leftovers(folder: Path) -> list[str]:
    """Return the names of what lies there, but for what KEPT names."""
    names = (path.name for path in folder.iterdir())
    return sorted(name for name in names if not any(fnmatch(name, kept) for kept in KEPT))
