"""Where sockets are looked for, and which addresses are refused."""

import os
from pathlib import Path

import pytest

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.endpoints import (
    arbiter_endpoint,
    check_endpoint,
    program_endpoint,
    runtime_dir,
    socket_path,
)

UID = 54_321


@pytest.mark.parametrize(
    ("environ", "folder"),
    [
        ({"VRAM_ARBITER_RUNTIME": "/a", "RUNTIME_DIRECTORY": "/b", "XDG_RUNTIME_DIR": "/c"}, "/a"),
        ({"RUNTIME_DIRECTORY": "/b:/b2", "XDG_RUNTIME_DIR": "/c"}, "/b"),
        ({"XDG_RUNTIME_DIR": "/c"}, "/c/vram-arbiter"),
    ],
)
def test_the_first_folder_that_is_named(environ: dict[str, str], folder: str) -> None:
    assert runtime_dir(environ, UID) == folder
    assert arbiter_endpoint(environ, UID) == f"ipc://{folder}/arbiter.sock"
    assert program_endpoint("runner", environ, UID) == f"ipc://{folder}/runner.sock"
    assert arbiter_endpoint({**environ, "VRAM_ARBITER_ENDPOINT": "ipc:///x"}, UID) == "ipc:///x"


def test_without_a_session_no_folder_is_guessed_below_tmp(tmp_path: Path) -> None:
    """Any user could make /tmp/vram-arbiter-UID first, and serve there."""
    with pytest.raises(ConfigError, match="XDG_RUNTIME_DIR is not set") as raised:
        runtime_dir({}, UID, str(tmp_path))
    assert "VRAM_ARBITER_RUNTIME" in raised.value.hint
    own = tmp_path / str(os.getuid())
    own.mkdir()
    assert runtime_dir({}, os.getuid(), str(tmp_path)) == f"{own}/vram-arbiter"
    own.rmdir()
    own.symlink_to("/tmp")
    if os.getuid() == 0:
        assert runtime_dir({}, 0, str(tmp_path)) == "/run/vram-arbiter"
    else:
        with pytest.raises(ConfigError):
            runtime_dir({}, os.getuid(), str(tmp_path))


@pytest.mark.parametrize(
    ("endpoint", "words", "hint"),
    [
        ("tcp://127.0.0.1:1", "without CURVE keys", "ipc://PATH"),
        ("ipc://@vram-arbiter", "abstract sockets have no permissions", "ipc://PATH"),
        ("ipc://x", "absolute path", "ipc:///run"),
        ("ipc://", "absolute path", "ipc:///run"),
        ("x", "'x' is not an endpoint", "ipc:///run"),
        ("ipc:///a\0b", "NUL", "ipc:///run"),
        ("ipc:///" + "x" * 107, "has 108 bytes, Linux allows 107", "shorter"),
    ],
)
def test_what_is_not_an_endpoint(endpoint: str, words: str, hint: str) -> None:
    with pytest.raises(ConfigError, match=words) as raised:
        socket_path(endpoint)
    assert hint in raised.value.hint


def test_undecodable_bytes_of_a_path_count_and_pass() -> None:
    assert check_endpoint("ipc:///a\udcff") == "ipc:///a\udcff"
    assert socket_path("ipc:///run/x.sock") == "/run/x.sock"
