"""One holder at a time; a dead holder holds nothing."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from arbiter.host.lockfile import LockFile
from schemas.errors import AlreadyRunning, ConfigError


def test_a_second_holder_is_told_who_the_first_is(tmp_path: Path) -> None:
    first, second = LockFile(tmp_path / "lock", "the socket"), LockFile(tmp_path / "lock", "the socket")
    first.acquire()
    with pytest.raises(AlreadyRunning, match=f"pid {os.getpid()}.* the socket") as raised:
        second.acquire()
    assert raised.value.details["pid"] == os.getpid()
    first.release()
    second.acquire()
    second.release()
    second.release()


def test_a_killed_holder_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    script = "import fcntl, os, sys; fd = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT); fcntl.flock(fd, fcntl.LOCK_EX)"
    script += "; os.write(fd, b'123456789\\n'); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        lock = LockFile(path, "the socket")
        with pytest.raises(AlreadyRunning, match="pid 123456789"):
            lock.acquire()
        child.kill()
        child.communicate()
    lock.acquire()
    assert path.read_text() == f"{os.getpid()}\n"
    lock.release()


def test_a_lock_that_cannot_be_made_is_a_config_error(tmp_path: Path) -> None:
    with pytest.raises(ConfigError):
        LockFile(tmp_path / "none" / "lock", "x").acquire()
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError):
        LockFile(tmp_path / "link", "x").acquire()
