"""Private folders and lock files: no links, nobody else's folder, one holder at a time."""

import os
import stat
import subprocess
import sys
from pathlib import Path

import pytest

from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError
from vram_arbiter.schemas.runtime.folders import LockFile, private_folder, socket_folder

FOREIGN = 54_321
as_root = pytest.mark.skipif(os.geteuid() != 0, reason="only root can make files of another user")


# -- folders
def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def test_a_folder_is_made_private_whatever_the_umask(tmp_path: Path) -> None:
    old = os.umask(0)
    try:
        private_folder(tmp_path / "a")
    finally:
        os.umask(old)
    assert mode_of(tmp_path / "a") == 0o700
    old = os.umask(0o077)
    try:
        private_folder(tmp_path / "b", os.getgid())
    finally:
        os.umask(old)
    assert mode_of(tmp_path / "b") == 0o750
    private_folder(tmp_path / "b")  # there already: left as it is
    assert mode_of(tmp_path / "b") == 0o750


def test_only_the_last_component_is_made(tmp_path: Path) -> None:
    """A mistyped --endpoint left a trail of folders."""
    with pytest.raises(ConfigError, match="No such file"):
        private_folder(tmp_path / "mistyped" / "x")
    with pytest.raises(ConfigError, match="No such file"):
        private_folder(tmp_path / "x", make=False)
    assert not list(tmp_path.iterdir())


def test_what_is_not_a_folder_of_its_own_is_refused(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with pytest.raises(ConfigError, match="file is not a directory"):
        private_folder(tmp_path / "file")
    (tmp_path / "elsewhere").mkdir(mode=0o700)
    (tmp_path / "link").symlink_to(tmp_path / "elsewhere")
    with pytest.raises(ConfigError, match="link is a link"):
        private_folder(tmp_path / "link")


def test_a_folder_that_others_may_write_is_refused(tmp_path: Path) -> None:
    """They could exchange the socket and the lock file in it. The units' folder is sticky: members
    cannot."""
    folder = tmp_path / "x"
    folder.mkdir()
    folder.chmod(0o1777)
    with pytest.raises(ConfigError, match="every user"):
        private_folder(folder)
    folder.chmod(0o770)
    with pytest.raises(ConfigError, match=f"every member of group {os.getgid()}"):
        private_folder(folder)
    folder.chmod(0o1770)
    private_folder(folder)


@as_root
def test_a_folder_of_another_user_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = tmp_path / "x"
    folder.mkdir(mode=0o700)
    os.chown(folder, FOREIGN, -1)
    with pytest.raises(ConfigError, match=f"belongs to uid {FOREIGN}"):
        private_folder(folder)
    with pytest.raises(ConfigError, match=f"belongs to uid {FOREIGN}"):
        private_folder(folder, shared=True)
    monkeypatch.setenv("VRAM_ARBITER_SERVER_USERS", str(FOREIGN))
    private_folder(folder, shared=True)  # as sidecars do in the folder of the arbiter's unit


def test_only_the_runtime_folder_is_made_for_a_socket(tmp_path: Path) -> None:
    """Regression: a mistyped endpoint left a trail of folders."""
    environ = {"VRAM_ARBITER_RUNTIME": str(tmp_path / "run")}
    with pytest.raises(ConfigError, match="No such file"):
        socket_folder(tmp_path / "mistyped", environ)
    socket_folder(tmp_path / "run", environ)
    assert [path.name for path in tmp_path.iterdir()] == ["run"]


# -- lock files
def test_a_second_holder_is_told_who_the_first_is(tmp_path: Path) -> None:
    first, second = (
        LockFile(tmp_path / "lock", "the socket"),
        LockFile(tmp_path / "lock", "the socket"),
    )
    second.check_free()  # nothing there, nothing made
    assert not list(tmp_path.iterdir())
    first.acquire()
    for refused in (second.acquire, second.check_free):
        with pytest.raises(AlreadyRunning, match=f"pid {os.getpid()}.* the socket") as raised:
            refused()
        assert raised.value.details["pid"] == os.getpid()
    first.release()
    second.check_free()
    second.acquire()
    second.release()
    second.release()


def test_a_killed_holder_holds_nothing(tmp_path: Path) -> None:
    path = tmp_path / "lock"
    script = (
        "import fcntl, os, sys; fd = os.open(sys.argv[1], os.O_RDWR | os.O_CREAT); fcntl.flock(fd, "
        "fcntl.LOCK_EX)"
    )
    script += "; os.write(fd, b'123456789\\n'); print(flush=True); sys.stdin.read()"
    with subprocess.Popen(
        [sys.executable, "-c", script, str(path)], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
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
    with pytest.raises(ConfigError, match="No such file"):
        LockFile(tmp_path / "none" / "lock", "x").acquire()
    (tmp_path / "lock").mkdir()
    with pytest.raises(ConfigError, match="Is a directory"):
        LockFile(tmp_path / "lock", "x").acquire()


@pytest.mark.parametrize("tie", [Path.symlink_to, Path.hardlink_to])
def test_a_lock_file_that_is_another_file_is_left_alone(tmp_path: Path, tie: object) -> None:
    """A lock file linked to another file made a server truncate that file, with the rights
    of root."""
    (tmp_path / "precious").write_text("kept")
    assert callable(tie)
    tie(tmp_path / "lock", tmp_path / "precious")
    for used in (
        LockFile(tmp_path / "lock", "x").acquire,
        LockFile(tmp_path / "lock", "x").check_free,
    ):
        with pytest.raises(ConfigError, match=r"is a link|2 names"):
            used()
    assert (tmp_path / "precious").read_text() == "kept"


@as_root
def test_another_user_keeps_no_server_from_its_own_folder(tmp_path: Path) -> None:
    """In the units' folder members of the group may add files: the arbiter would not have started
    again."""
    tmp_path.chmod(0o1770)
    (tmp_path / "precious").write_text("kept")
    planted = tmp_path / "lock"
    for plant in (planted.touch, lambda: planted.symlink_to(tmp_path / "precious")):
        planted.unlink(missing_ok=True)
        plant()
        os.chown(planted, FOREIGN, -1, follow_symlinks=False)
        lock = LockFile(planted, "x")
        lock.acquire()
        assert planted.lstat().st_uid == os.geteuid()
        lock.release()
    assert (tmp_path / "precious").read_text() == "kept"


@as_root
def test_a_lock_file_of_another_user_in_a_shared_folder_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As for a sidecar in the folder of the arbiter's unit: it may not remove what others put
    there."""
    monkeypatch.setenv("VRAM_ARBITER_SERVER_USERS", str(FOREIGN))
    folder = tmp_path / "shared"
    folder.mkdir(mode=0o700)
    (folder / "lock").touch()
    os.chown(folder / "lock", FOREIGN, -1)
    os.chown(folder, FOREIGN, -1)
    with pytest.raises(ConfigError, match=f"uid {FOREIGN}"):
        LockFile(folder / "lock", "x").acquire()
