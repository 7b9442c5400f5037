"""A robot's key on the GPU server: its line, its user, and keys that are none."""

import base64
import os
from pathlib import Path

import pytest

from tests.support.process import vramctl
from vram_arbiter.clients.remote.authorize import Guest, read_key
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE, SYSTEM_RUNTIME


def key(kind: str = "ssh-ed25519", body: bytes = bytes(36)) -> str:
    return f"{kind} {base64.b64encode(len(kind).to_bytes(4) + kind.encode() + body).decode()}"


def test_a_line_names_all_that_is_reached() -> None:
    guest = Guest("arm1", key(), ("grab",), (8000,))
    assert guest.line == (
        'restrict,port-forwarding,permitopen="[/run/vram-arbiter/arbiter.sock]:*",'
        'permitopen="[/run/vram-arbiter/grab.sock]:*",permitopen="127.0.0.1:8000" '
        f"{key()} arm1"
    )


@pytest.mark.parametrize("kind", ["ssh-ed25519", "sk-ssh-ed25519@openssh.com", "ssh-rsa"])
def test_a_keys_remark_is_not_kept(tmp_path: Path, kind: str) -> None:
    path = tmp_path / "k.pub"
    path.write_text(f"\n{key(kind)}   somebody, somewhere\n")
    assert read_key(path) == key(kind)


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("-----BEGIN OPENSSH PRIVATE KEY-----\n", "is a private key, which stays on the robot"),
        ("", "expected one public key"),
        (f"{key()} a\n{key()} b\n", "expected one public key"),
        (f'command="id" {key()}', "expected one public key"),
        ("ssh-ed25519 AAAA=A", "expected one public key"),
        ("ssh-ed25519", "expected one public key"),
        (key().replace("ssh-ed25519", "ssh-rsa"), "its body is not of ssh-rsa"),
        (key(body=b""), "its body is not of ssh-ed25519"),
        ("\x00\udcff", "expected one public key"),
    ],
)
def test_what_is_no_key(tmp_path: Path, text: str, problem: str) -> None:
    path = tmp_path / "k"
    path.write_text(text, errors="surrogateescape")
    with pytest.raises(ConfigError, match=problem) as refused:
        read_key(path)
    assert "ssh-keygen" in refused.value.hint


def test_no_file() -> None:
    with pytest.raises(ConfigError, match="expected one public key"):
        read_key(Path("/nowhere/k.pub"))


def test_it_says_what_the_robot_may_and_what_to_run(tmp_path: Path) -> None:
    path = tmp_path / "k.pub"
    path.write_text(key())
    command = [
        "remote",
        "authorize",
        str(path),
        "--name",
        "arm1",
        "--sidecar",
        "grab",
        "--door",
        "8000",
    ]
    told = vramctl(*command, environ=os.environ | {RUNTIME_VARIABLE: SYSTEM_RUNTIME})
    assert told.returncode == 0, told.stderr
    lines = told.stdout.splitlines()
    assert lines[0] == Guest("arm1", key(), ("grab",), (8000,)).line
    assert "  /run/vram-arbiter/grab.sock" in lines
    assert "  hold a lease, evict, pin or drain" in lines
    assert any(line.startswith("  useradd --system") for line in lines)


@pytest.mark.parametrize(
    "wrong",
    [["--name", "Arm 1"], ["--name", "a", "--sidecar", 'x"y'], ["--name", "a", "--door", "0"]],
)
def test_what_would_change_the_line_is_refused(wrong: list[str]) -> None:
    told = vramctl("remote", "authorize", "k.pub", *wrong, environ=os.environ)
    assert told.returncode == 2
    assert "expected" in told.stderr


def test_a_damaged_key_is_one_line(tmp_path: Path) -> None:
    path = tmp_path / "k.pub"
    path.write_text("ssh-ed25519 AAAA")
    told = vramctl("remote", "authorize", str(path), "--name", "arm1", environ=os.environ)
    assert told.returncode == 2
    assert "the key is damaged" in told.stderr
    assert told.stderr.count("\n") == 1


def test_a_user_that_exists_is_put_into_the_groups() -> None:
    _, joined, _ = Guest("arm1", key()).commands()
    assert joined == ["usermod", "--append", "--groups", "vram-arbiter,vram-guests", "vram-arm1"]
