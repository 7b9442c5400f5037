"""`vramctl remote` against a real sshd: a tunnel comes, is used by stock clients, and is lost in
each way that there is."""

import os
import signal
import socket
from collections.abc import Iterator

import pytest

from tests.support.guests import USER
from tests.support.processes import children
from tests.support.remote import Remote, wait_for_line
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.sync import Client, Lease
from vram_arbiter.schemas.errors import RemoteMayNotHold

pytestmark = pytest.mark.e2e


@pytest.fixture
def lease(remote: Remote) -> Iterator[Lease]:
    """A model on the server."""
    with (
        Client("grab", endpoint=remote.arbiter.endpoint) as server,
        server.lease(vram="1GiB", model="pi0", unload=lambda: None) as held,
    ):
        held.ready()
        yield held


def uses(client: Client) -> int:
    return sum(lease.uses for lease in client.status().leases)


def test_a_stock_client_is_a_guest_of_the_server(remote: Remote, lease: Lease) -> None:
    keeper = remote.up()
    with (
        Client("robot", endpoint=remote.endpoint) as robot,
        Client("watcher", endpoint=remote.arbiter.endpoint) as watcher,
    ):
        assert robot.role == "guest"
        with robot.use(lease.lease_id, lease.token, "grab"):
            assert uses(watcher) == 1
        with pytest.raises(RemoteMayNotHold):
            robot.acquire(vram="1GiB", model="x")
        (told,) = remote.status()
        assert (told["host"], told["state"], told["role"]) == (remote.host, "up", "guest")
        assert told["round_trip_ms"] > 0
    keeper.send_signal(signal.SIGTERM)
    assert keeper.wait(PATIENCE_S) == 0
    assert [path.name for path in remote.folder.iterdir()] == ["tunnel.lock"]


@pytest.mark.nightly
@pytest.mark.parametrize("how", ["server", "ssh", "frozen"])
def test_a_lost_tunnel_comes_back_and_so_do_its_clients(
    remote: Remote, lease: Lease, how: str
) -> None:
    keeper = remote.up()
    with (
        Client("robot", endpoint=remote.endpoint) as robot,
        Client("watcher", endpoint=remote.arbiter.endpoint) as watcher,
    ):
        use = robot.begin_use(lease.lease_id, lease.token, "grab")
        assert uses(watcher) == 1
        if how == "server":
            remote.sshd.kill(USER)
        elif how == "frozen":
            remote.sshd.freeze(USER)
        else:
            (ssh,) = children(keeper.pid)
            os.kill(ssh, signal.SIGKILL)
        wait_for_line(keeper, "no tunnel to")
        wait_for_line(keeper, "is up")
        until(lambda: robot.connected)
        robot.ping()
        use.end()
        until(lambda: uses(watcher) == 0)
        if how == "frozen":
            remote.sshd.kill(USER)


@pytest.mark.nightly
def test_a_refusal_ends_the_keeper_with_its_reason(remote: Remote) -> None:
    """One after the other, with one sshd."""

    def refused(*arguments: str, host: str = "") -> str:
        keeper = remote.keeper(*arguments, host=host)
        _, said = keeper.communicate(timeout=PATIENCE_S)
        assert keeper.returncode == 1, said
        (line,) = said.splitlines()
        return line

    assert "vramctl remote authorize" in refused(host=f"arm2@127.0.0.1:{remote.sshd.port}")
    assert "host key is known for" in refused(host=f"{USER}@localhost:{remote.sshd.port}")
    assert "grab is not served there" in refused("grab")

    remote.sshd.authorized(USER).write_text(f"restrict {remote.sshd.public_key(USER)}\n")
    assert "may this key and this user" in refused()
    assert any("refused streamlocal" in said for said in remote.sshd.log)
    remote.authorize()

    name = remote.sshd.host_key_line.split()[0]
    remote.known_hosts.write_text(f"{name} {remote.sshd.public_key(USER)}\n")
    assert "HAS CHANGED" in refused()
    remote.known_hosts.write_text(remote.sshd.host_key_line + "\n")

    with socket.create_server(("127.0.0.1", 0)) as taken:
        assert "has the port" in refused("--door", str(taken.getsockname()[1]))
    remote.up()
    assert "already uses the tunnel" in refused()
