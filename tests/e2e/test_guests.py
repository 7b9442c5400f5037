"""A robot behind a real ssh: what it reaches, and how soon its uses end with its tunnel, its
program or the network. Real sshd, daemon and clients; the robot has a network of its own.
"""

import contextlib
import os
import shutil
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from tests.support.guests import USER, Server, sshd_server
from tests.support.process import Make
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient
from vram_arbiter.clients.sync import Client, Lease
from vram_arbiter.schemas.errors import RemoteMayNotHold
from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE, SYSTEM_RUNTIME

pytestmark = [
    pytest.mark.e2e,
    pytest.mark.skipif(os.getuid() != 0, reason="needs root: sshd changes to the users' accounts"),
]
KILLED_S = 1.0
"""0.1 s on a free machine."""
SILENT_S = 5.0
Ends = Callable[["subprocess.Popen[str]", Server], object]
KILLED: dict[str, Ends] = {
    "ssh is killed": lambda ssh, _: ssh.kill(),
    "the session is killed": lambda _, there: there.sshd.kill(USER),
}
SILENT: dict[str, Ends] = {
    "ssh is frozen": lambda ssh, _: ssh.send_signal(signal.SIGSTOP),
    "the session is frozen": lambda _, there: there.sshd.freeze(USER),
    "packets are lost": lambda _, there: there.sshd.silence(),
}


@contextmanager
def policy_server(there: Server) -> Iterator[tuple[Client, Lease]]:
    """The holder of 5 of 8 GiB, which may be evicted between uses at once."""
    with Client("policy", endpoint=there.endpoint) as policy:
        fields: dict[str, Any] = {"vram": "5GiB", "model": "pi0", "min_residency_s": 0.0}
        lease = policy.acquire(unload=lambda: None, **fields)
        lease.ready()
        yield policy, lease


def begun_again(client: Client) -> list[str]:
    """Return the labels of uses that were said again after a restart."""
    events = client.history(kinds=["use_began"]).events
    return [one["label"] for one in events if one["resumed"]]


def uses(client: Client, lease: Lease) -> int:
    return sum(one.uses for one in client.status().leases if one.lease_id == lease.lease_id)


def seconds_until_the_grant(
    there: Server, policy: Client, lease: Lease, ends: Callable[[], object]
) -> float:
    """Let another model need the memory; once it waits for the use, let the use end in some way.
    Return the time from there to the grant."""
    with Client("other", endpoint=there.endpoint) as other, ThreadPoolExecutor(1) as pool:

        def granted() -> float:
            lease = other.acquire(vram="5GiB", model="vlm", wait_timeout_s=PATIENCE_S)
            at = time.monotonic()
            lease.ready()
            lease.give_up()
            return at

        waiting = pool.submit(granted)
        until(lambda: lease.revoking)
        began = time.monotonic()
        ends()
        took = waiting.result(PATIENCE_S) - began
    events = [one for one in policy.history().events if one.get("lease_id") == lease.lease_id]
    kinds = [one["kind"] for one in events]
    assert kinds.index("use_ended") < kinds.index("unloading"), "never inside the use"
    return took


def test_a_guest_through_ssh_uses_and_holds_nothing(make_arbiter: Make, tmp_path: Path) -> None:
    with (
        sshd_server(make_arbiter, tmp_path) as there,
        policy_server(there) as (policy, lease),
        there.tunnel() as (ssh, endpoint),
        Client("arm1", endpoint=endpoint) as robot,
    ):
        with pytest.raises(RemoteMayNotHold, match="--name arm1 --vram 1GiB"):
            robot.acquire(vram="1GiB", model="m")
        with robot.use(lease.lease_id, lease.token, "goal"):
            until(lambda: uses(policy, lease) == 1)
            ssh.kill()
            until(lambda: uses(policy, lease) == 0)


@contextmanager
def events_flow(there: Server) -> Iterator[None]:
    """Events several times a second, for subscribers."""
    over = threading.Event()
    with Client("busy", endpoint=there.endpoint) as busy, ThreadPoolExecutor(1) as pool:
        lease = busy.acquire(vram="64MiB", model="small")
        lease.ready()

        def talk() -> None:
            while not over.wait(0.2):
                with lease.use():
                    pass

        talking = pool.submit(talk)
        try:
            yield
        finally:
            over.set()
            talking.result(PATIENCE_S)
            lease.give_up()


@pytest.mark.nightly
@pytest.mark.parametrize("how", KILLED | SILENT)
def test_a_use_ends_with_the_tunnel_or_the_network(
    make_arbiter: Make, tmp_path: Path, how: str
) -> None:
    """sshd 9.2 gave a silent client up after 8 s, and not in 30 while it had something to send: the
    robot subscribes, and there is always an event to send."""
    with (
        sshd_server(make_arbiter, tmp_path, network=True) as there,
        policy_server(there) as (policy, lease),
        events_flow(there),
        there.tunnel() as (ssh, endpoint),
        Client("arm1", endpoint=endpoint) as robot,
        WireClient(endpoint) as subscriber,
        robot.use(lease.lease_id, lease.token, "goal"),
    ):
        assert subscriber.hello().ask("subscribe")["ok"]
        until(lambda: uses(policy, lease) == 1)
        ends = (KILLED | SILENT)[how]
        took = seconds_until_the_grant(there, policy, lease, lambda: ends(ssh, there))
        print(f"{how}: granted after {took:.2f} s")
        assert took < (KILLED_S if how in KILLED else SILENT_S)


@pytest.mark.nightly
def test_a_use_ends_with_the_robots_program(make_arbiter: Make, tmp_path: Path) -> None:
    """The tunnel lives on. A program that ends is noticed at once, one that is frozen by its
    silence."""
    with (
        sshd_server(make_arbiter, tmp_path) as there,
        policy_server(there) as (policy, lease),
        there.tunnel() as (_, endpoint),
    ):
        on = {"lease_id": lease.lease_id, "token": list(lease.token), "use_id": "goal"}
        with WireClient(endpoint) as robot:
            assert robot.hello().ask("use_begin", **on)["ok"]
        until(lambda: uses(policy, lease) == 0, SILENT_S)
        with WireClient(endpoint) as robot:
            assert robot.hello().ask("use_begin", **on)["ok"]
            took = seconds_until_the_grant(there, policy, lease, lambda: None)
            assert took < SILENT_S


@pytest.mark.nightly
def test_a_robot_that_comes_back_uses_anew(make_arbiter: Make, tmp_path: Path) -> None:
    """Its old use is lost, with the reason; the session and the tunnel are the same."""
    with (
        sshd_server(make_arbiter, tmp_path, network=True) as there,
        policy_server(there) as (policy, lease),
        there.tunnel() as (ssh, endpoint),
        Client("arm1", endpoint=endpoint) as robot,
    ):
        with robot.use(lease.lease_id, lease.token, "old") as old:
            ends = partial(ssh.send_signal, signal.SIGSTOP)
            seconds_until_the_grant(there, policy, lease, ends)
            ssh.send_signal(signal.SIGCONT)
            lost = until(lambda: old.lost)
        assert "is released: other needs the room" in str(lost)
        again = policy.acquire(vram="5GiB", model="pi0", unload=lambda: None)
        again.ready()
        with robot.use(again.lease_id, again.token, "new"):
            until(lambda: uses(policy, again) == 1)
        until(lambda: uses(policy, again) == 0)


@pytest.mark.nightly
def test_a_guests_use_outlives_the_daemon(make_arbiter: Make, tmp_path: Path) -> None:
    """The journal names sshd's process, and the robot says its use again through the tunnel."""
    with (
        sshd_server(make_arbiter, tmp_path) as there,
        policy_server(there) as (policy, lease),
        there.tunnel() as (_, endpoint),
        Client("arm1", endpoint=endpoint) as robot,
        robot.use(lease.lease_id, lease.token, "goal") as use,
    ):
        there.arbiter.kill()
        there.arbiter.start()
        assert uses(policy, lease) == 1
        until(lambda: "goal" in begun_again(policy))
        assert use.lost is None
        use.end()
        until(lambda: uses(policy, lease) == 0)


@pytest.mark.nightly
def test_guests_do_not_end_each_others_uses(make_arbiter: Make, tmp_path: Path) -> None:
    users = (USER, "arm2")
    with (
        sshd_server(make_arbiter, tmp_path, users) as there,
        policy_server(there) as (policy, lease),
        there.tunnel(USER) as (_, one),
        there.tunnel("arm2") as (_, two),
        WireClient(one) as robot,
        WireClient(two) as other,
    ):
        on = {"lease_id": lease.lease_id, "token": list(lease.token), "use_id": "goal"}
        assert robot.hello().ask("use_begin", **on)["ok"]
        assert other.hello().ask("use_end", **on)["ok"], "there is none of its own"
        assert uses(policy, lease) == 1
        there.sshd.kill("arm2")
        assert robot.ask("use_end", **on)["uses"] == 0


@pytest.mark.nightly
def test_an_installed_key_is_that_of_a_user_in_both_groups(tmp_path: Path) -> None:
    """`vramctl remote authorize --install` on a machine of its own: a copy of /etc."""
    there = tmp_path / "etc"
    shutil.copytree("/etc", there, symlinks=True)
    with (there / "group").open("a") as groups:
        groups.write("vram-arbiter:x:5901:\nvram-guests:x:5902:\n")
    subprocess.run(
        ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-f", tmp_path / "k"], check=True
    )
    command = ["remote", "authorize", str(tmp_path / "k.pub"), "--name", "arm1", "--install"]
    program = [sys.executable, "-m", "vram_arbiter.clients", *command]
    script = 'mount --bind "$0" /etc && "$@" && "$@" && id -nG vram-arm1'
    done = subprocess.run(
        ["unshare", "--mount", "sh", "-c", script, str(there), *program],
        env=os.environ | {RUNTIME_VARIABLE: SYSTEM_RUNTIME},
        capture_output=True, text=True, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    assert {"vram-arbiter", "vram-guests"} <= set(done.stdout.splitlines()[-1].split())
    line = (there / "ssh/vram-guests/vram-arm1").read_text()
    assert line.startswith('restrict,port-forwarding,permitopen="[/run/vram-arbiter/arbiter.sock]')
    assert not Path("/etc/ssh/vram-guests/vram-arm1").exists()


@pytest.mark.nightly
def test_an_authorized_key_opens_what_its_line_names(make_arbiter: Make, tmp_path: Path) -> None:
    """What sshd does, not what its manual says: it compares paths of sockets with `permitopen`."""
    users = (USER, "arm2")
    with sshd_server(make_arbiter, tmp_path, users) as there, ExitStack() as stack:
        runtime = there.arbiter.runtime
        doors = [stack.enter_context(greeting(socket.AF_INET, ("127.0.0.1", 0))) for _ in "ab"]
        ports = [door.getsockname()[1] for door in doors]
        for name in ("grab", "other"):
            stack.enter_context(greeting(socket.AF_UNIX, f"{runtime}/{name}.sock"))
            (runtime / f"{name}.sock").chmod(0o666)
        there.authorize(USER, "grab", doors=(ports[0],))
        there.authorize("arm2")
        targets = [f"{runtime}/{name}.sock" for name in ("arbiter", "grab", "other")]
        targets += [f"127.0.0.1:{port}" for port in ports]
        opened = {user: [opens(there, user, target) for target in targets] for user in users}
        assert opened == {
            USER: [True, True, False, True, False],
            "arm2": [True, False, False, False, False],
        }


@pytest.mark.nightly
def test_nothing_but_forwarding(make_arbiter: Make, tmp_path: Path) -> None:
    with sshd_server(make_arbiter, tmp_path) as there:
        for arguments in (["id"], ["-tt"], ["-s", "sftp"], []):
            with there.ssh(*arguments) as ssh:
                assert ssh.wait(PATIENCE_S) != 0
                assert ssh.stdout is not None
                assert ssh.stdout.read() == ""
        for back in (f"{tmp_path}/back:{there.endpoint[6:]}", "127.0.0.1:0:127.0.0.1:22"):
            with there.ssh("-N", "-R", back) as ssh:
                assert ssh.wait(PATIENCE_S) != 0, "the server listens for no robot"


@contextmanager
def greeting(family: socket.AddressFamily, address: Any) -> Iterator[socket.socket]:
    """Listen, and greet each that connects until the end of the block."""
    with socket.socket(family) as listener, ThreadPoolExecutor(1) as pool:
        listener.bind(address)
        listener.listen()

        def greet() -> None:
            with contextlib.suppress(OSError):
                while True:
                    with listener.accept()[0] as one:
                        one.sendall(b"hello")

        pool.submit(greet)
        try:
            yield listener
        finally:
            listener.shutdown(socket.SHUT_RDWR)


def opens(there: Server, user: str, target: str) -> bool:
    """Return whether sshd lets a user through to a socket or a port, whose server speaks first."""
    here = there.sshd.folder / "tried.sock"
    with there.ssh("-N", "-L", f"{here}:{target}", user=user) as ssh:
        until(lambda: here.exists() or ssh.poll() is not None)
        with socket.socket(socket.AF_UNIX) as tried:
            tried.settimeout(PATIENCE_S)
            tried.connect(str(here))
            heard = tried.recv(1)
    here.unlink()
    return bool(heard)
