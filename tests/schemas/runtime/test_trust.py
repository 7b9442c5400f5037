"""Clients ask the kernel which user serves a socket: a false server was believed by everything that
asked it."""

import os
import pwd
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import SUPPORT
from vram_arbiter.schemas.errors import ConfigError, UntrustedServer, from_wire
from vram_arbiter.schemas.runtime.trust import (
    SERVICE_USERS,
    check_server,
    check_uid,
    frame_uid,
    port_uids,
    trusts,
)

FOREIGN = 54_321
as_root = pytest.mark.skipif(
    os.geteuid() != 0, reason="only root can start a server of another user"
)
FALSE_SERVER = SUPPORT / "false_server.py"


def test_root_and_the_own_user_are_trusted(tmp_path: Path) -> None:
    with socket.socket(socket.AF_UNIX) as server, socket.socket(socket.AF_UNIX) as client:
        server.bind(str(tmp_path / "s"))
        server.listen()
        client.connect(str(tmp_path / "s"))
        check_server(client, "runner", "here")
    assert trusts(0, "arbiter")


@as_root
def test_the_kernel_names_the_user_who_listens(tmp_path: Path) -> None:
    nobody = pwd.getpwnam("nobody").pw_uid
    os.chown(tmp_path, nobody, -1)
    command = [sys.executable, str(FALSE_SERVER), str(tmp_path), "s", str(nobody)]
    with (
        subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child,
        socket.socket(socket.AF_UNIX) as client,
    ):
        child.stdout.readline()
        client.connect(str(tmp_path / "s"))
        with pytest.raises(UntrustedServer, match=rf"served by uid {nobody} \(nobody\)") as raised:
            check_server(client, "runner", f"ipc://{tmp_path}/s")
        child.communicate()
    again = from_wire(raised.value.to_wire())
    assert isinstance(again, UntrustedServer)
    assert again.details["uid"] == nobody


@pytest.mark.parametrize("address", ["127.0.0.1", "0.0.0.0", "::"])
def test_the_kernel_names_the_user_behind_a_port(address: str) -> None:
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    if ":" in address and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    with (
        socket.create_server((address, 0), family=family, dualstack_ipv6=":" in address) as server,
        socket.create_connection(("127.0.0.1", server.getsockname()[1])) as client,
    ):
        assert port_uids(client) == {os.geteuid()}, "nobody has accepted it: who listens"
        accepted, _ = server.accept()
        server.close()
        assert port_uids(client) == {os.geteuid()}, "the owner of the other end"
        accepted.close()
        assert port_uids(client) == set(), "there is none any more"


@pytest.mark.parametrize("address", ["127.0.0.1", "127.0.0.2", "::1"])
def test_a_server_learns_which_user_has_connected(address: str) -> None:
    """The status page divides its connections by users."""
    family = socket.AF_INET6 if ":" in address else socket.AF_INET
    if ":" in address and not socket.has_dualstack_ipv6():
        pytest.skip("no IPv6 here")
    with (
        socket.create_server((address, 0), family=family) as server,
        socket.create_connection(server.getsockname()[:2]) as client,
    ):
        accepted, _ = server.accept()
        with accepted:
            assert port_uids(accepted) == {os.geteuid()}
            client.close()
            assert port_uids(accepted) == set(), "there is none any more"


@as_root
def test_every_user_who_listens_on_the_port_counts() -> None:
    """The kernel names no owner of a connection that waits to be accepted: it read as root's."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        os.fchown(server.fileno(), FOREIGN, -1)
        with socket.create_connection(server.getsockname()) as client:
            assert port_uids(client) == {FOREIGN}


def test_users_can_be_named() -> None:
    named = {"VRAM_ARBITER_SERVER_USERS": f"root, {FOREIGN}"}
    check_uid(FOREIGN, "arbiter", "x", named)
    with pytest.raises(UntrustedServer, match=f"VRAM_ARBITER_SERVER_USERS={FOREIGN + 1}"):
        check_uid(FOREIGN + 1, "arbiter", "x", named)
    with pytest.raises(ConfigError, match="'no-such-user', which is not a user"):
        trusts(FOREIGN, "arbiter", {"VRAM_ARBITER_SERVER_USERS": "no-such-user"})


def test_the_units_users_are_those_that_are_trusted() -> None:
    """Only for their own program: a sidecar, which reads foreign weights, is not believed as the
    arbiter."""
    units = Path(__file__).parents[3] / "configs/systemd/system"
    for program, user in SERVICE_USERS.items():
        unit = units / (
            "vram-arbiter.service" if program == "arbiter" else f"vram-{program}@.service"
        )
        lines = unit.read_text().splitlines()
        assert f"User={user}" in lines
        assert "PrivateUsers=yes" not in lines  # every other user would be 65534 there
    assert len({SERVICE_USERS[program] for program in ("arbiter", "runner", "sidecar")}) == 3


@pytest.mark.parametrize(
    ("address", "uid"),
    [
        ("localhost:0:0:17", 0),
        ("localhost:1000:1000:17", 1000),
        ("127.0.0.1", None),
        ("", None),
        (None, None),
        ("a:-1:2:3", None),
    ],
)
def test_the_uid_of_a_frame(address: str | None, uid: int | None) -> None:
    assert frame_uid(address) == uid
