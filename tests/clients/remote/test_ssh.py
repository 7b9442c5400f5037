"""A tunnel's command line, the folder of its sockets, and what ssh's words mean. Nothing runs."""

import socket
from pathlib import Path

import pytest

from vram_arbiter.clients.remote.ssh import Tunnel, folder_of, forwarded, host_of
from vram_arbiter.clients.remote.tunnel import refusal
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable

UID = 1000
CHANGED = (
    "@@@@@@@@@@@",
    "@    WARNING: REMOTE HOST IDENTIFICATION HAS CHANGED!     @",
    "Host key for box has changed and you have requested strict checking.",
    "Host key verification failed.",
)
UNKNOWN = (
    "No ED25519 host key is known for [10.0.0.5]:2201 and you have requested strict checking.",
    "Host key verification failed.",
)


def tunnel(folder: Path = Path("/run/r/remote/box"), **fields: object) -> Tunnel:
    made = {"host": "box", "folder": folder, "known_hosts": Path("/etc/k")} | fields
    return Tunnel(**made)  # type: ignore[arg-type]


def test_the_command_line_pins_the_host_and_forwards_by_name() -> None:
    words = tunnel(host="arm1@box:2201", names=("arbiter", "grab"), doors=((8080, 8081),)).command()
    assert words[-2:] == ["--", "ssh://arm1@box:2201"]
    told = [words[at + 1] for at, word in enumerate(words) if word == "-o"]
    assert {"StrictHostKeyChecking=yes", "UserKnownHostsFile=/etc/k", "BatchMode=yes"} <= {*told}
    assert [words[at + 1] for at, word in enumerate(words) if word == "-L"] == [
        "/run/r/remote/box/arbiter.sock:/run/vram-arbiter/arbiter.sock",
        "/run/r/remote/box/grab.sock:/run/vram-arbiter/grab.sock",
        "127.0.0.1:8080:127.0.0.1:8081",
    ]


@pytest.mark.parametrize(
    "host", ["", "-oProxyCommand=x", "a b", "a/b", "box:x", "box:99999", "../box", "a@b@c"]
)
def test_what_is_not_a_server_is_refused(host: str) -> None:
    with pytest.raises(ConfigError, match="expected a server"):
        folder_of(host, {"VRAM_ARBITER_RUNTIME": "/run/r"}, UID)


@pytest.mark.parametrize("runtime", ["/run/a:b", "/run/a b", "/run/%h", "/run/$HOME", "relative"])
def test_a_path_that_ssh_would_read_otherwise_is_refused(runtime: str) -> None:
    with pytest.raises(ConfigError):
        tunnel(server_runtime=runtime).command()


def test_a_servers_folder_names_it(tmp_path: Path) -> None:
    folder = folder_of("arm1@box:2201", {"VRAM_ARBITER_RUNTIME": str(tmp_path)}, UID)
    assert folder == tmp_path / "remote/arm1@box,2201"
    assert host_of(folder) == "arm1@box:2201"


@pytest.mark.parametrize(
    ("words", "reason", "hint"),
    [
        (CHANGED, "host_key", "/etc/k"),
        (UNKNOWN, "host_key", "ssh-keyscan"),
        (["a@box: Permission denied (publickey)."], "key", "remote authorize"),
        (["arbiter is not served there"], "not_served", "--server-runtime"),
        (["bind [127.0.0.1]:8080: Address already in use"], "port", "port"),
    ],
)
def test_a_refusal_says_what_to_do(words: list[str], reason: str, hint: str) -> None:
    error = refusal(tunnel(), words, reached=False)
    assert error.details["reason"] == reason
    assert hint in error.hint


def test_a_loss_is_no_refusal() -> None:
    assert refusal(tunnel(), ["Timeout, server box not responding."], reached=False) is None
    starting = ["arbiter is not served there"]
    assert refusal(tunnel(), starting, reached=True) is None, "the server starts again"


def test_an_address_is_the_socket_of_a_tunnel_that_is_up(tmp_path: Path) -> None:
    environ = {"VRAM_ARBITER_RUNTIME": str(tmp_path)}
    for wrong in ("ipc:///run/grab.sock", "ssh://box", "ssh://box/", "ssh://box/a/b"):
        with pytest.raises(ConfigError):
            forwarded(wrong, environ, UID)
    with pytest.raises(SidecarUnavailable, match="no tunnel to box") as raised:
        forwarded("ssh://box/grab", environ, UID)
    assert "vramctl remote up box grab" in raised.value.hint

    folder = folder_of("box", environ, UID)
    folder.mkdir(parents=True)
    with socket.socket(socket.AF_UNIX) as arbiter, socket.socket(socket.AF_UNIX) as grab:
        for listener, name in ((arbiter, "arbiter"), (grab, "grab")):
            listener.bind(str(folder / f"{name}.sock"))
            listener.listen()
        assert forwarded("ssh://box/grab", environ, UID) == (
            f"ipc://{folder}/grab.sock",
            f"ipc://{folder}/arbiter.sock",
        )
    with pytest.raises(SidecarUnavailable):  # the files are left over
        forwarded("ssh://box/grab", environ, UID)
