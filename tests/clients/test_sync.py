"""The blocking client against a real daemon: threads, callbacks, forks."""

import os
import subprocess
import sys
import threading
from pathlib import Path

import pytest

from tests.support.leases import Spec, view_of
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.errors import ArbiterUnreachable, BadState, LeaseLost, LeaseRevoking

pytestmark = pytest.mark.e2e


def test_lease_use_release(client: Client, spec: Spec) -> None:
    with client.lease(spec("a", 5)) as lease:
        lease.ready(5 << 30)
        with lease.use("detect"):
            assert client.status().leases[0].uses == 1
        with client.use(lease.lease_id, lease.token, "of another"):
            assert client.status().leases[0].uses == 1
        assert client.status().leases[0].uses == 0
        assert lease.state == "held"
        assert client.why("a").leases[0].state == "held"
    assert lease.state == "gone"
    with pytest.raises(LeaseLost), lease.use():
        pytest.fail("a use began on a released lease")


def test_revoked_between_uses_in_a_worker_thread(client: Client, spec: Spec) -> None:
    loop_thread = threading.Event()
    unloaded, asked = threading.Event(), threading.Event()

    def unload() -> None:
        if threading.current_thread().name == "vram-arbiter-client":
            loop_thread.set()
        unloaded.set()

    lease = client.acquire(spec("a", 5), unload=unload, on_revoke=lambda *_: asked.set())
    lease.ready()
    granted: list[str] = []
    with lease.use("goal"):
        waiter = threading.Thread(
            target=lambda: granted.append(client.acquire(spec("b", 5)).lease_id)
        )
        waiter.start()
        assert asked.wait(PATIENCE_S)
        with pytest.raises(LeaseRevoking), lease.use():
            pytest.fail("a use began on a lease that is asked to leave")
        assert not unloaded.is_set()
    waiter.join(PATIENCE_S)
    assert granted
    assert unloaded.is_set()
    assert not loop_thread.is_set()


def test_a_use_that_begins_as_the_lease_is_revoked_keeps_it(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """It waits neither for the arbiter nor for the client's thread. The model stays until its end,
    and the arbiter, which refused it and showed a holder without uses, says so."""
    busy, go, unloaded, granted = (threading.Event() for _ in range(4))

    def hold_up(_: str) -> None:
        busy.set()
        assert go.wait(PATIENCE_S)

    def wait_for_room() -> None:
        other.acquire(spec("b", 5))
        granted.set()

    lease = client.acquire(spec("a", 5), unload=unloaded.set)
    lease.ready()
    client.on_prepare(hold_up)
    with Client("waiter", endpoint=arbiter_daemon.endpoint) as other:
        other.prepare(client.name)
        assert busy.wait(PATIENCE_S)
        waiting = threading.Thread(target=wait_for_room)
        waiting.start()
        until(lambda: view_of(other, "a").state == "revoking")
        with lease.use("crossing"):
            assert lease.state == "held", "it has not heard of the revoke"
            go.set()
            assert lease.wait_change("held") == "revoking"
            with pytest.raises(LeaseRevoking), lease.use():
                pytest.fail("a use began on a lease that is asked to leave")
            until(lambda: view_of(other, "a").uses == 1)
            assert view_of(other, "a").state == "revoking"
            assert not unloaded.is_set()
            assert not granted.is_set()
        waiting.join(PATIENCE_S)
        assert unloaded.is_set()
        assert granted.is_set()
        daemon = other.status().daemon
        assert not daemon.refusals


def test_a_call_in_the_clients_own_thread_is_refused(client: Client) -> None:
    refused = threading.Event()

    def hinted(_: str) -> None:
        with pytest.raises(BadState, match="serves the client"):
            client.status()
        refused.set()

    client.on_prepare(hinted)
    client.prepare(client.name)
    assert refused.wait(PATIENCE_S)


def test_events_can_be_iterated(client: Client, spec: Spec) -> None:
    kinds: list[str] = []
    seen = threading.Event()

    def follow() -> None:
        for event in client.subscribe():
            kinds.append(event["kind"])
            if event["kind"] == "released":
                break
        seen.set()

    threading.Thread(target=follow, daemon=True).start()
    while not seen.wait(0.05):  # the subscription may begin after the first of these leases
        with client.lease(spec("a", 1)) as lease:
            lease.ready()
    assert "released" in kinds


@pytest.mark.filterwarnings("ignore:This process .* is multi-threaded:DeprecationWarning")
def test_not_across_a_fork(client: Client, spec: Spec) -> None:
    lease = client.acquire(spec("a", 1))
    pid = os.fork()
    if pid == 0:
        try:
            client.__exit__(None, None, None)  # only forgets
            lease.ready()
        except BadState:
            os._exit(0)
        os._exit(1)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0
    lease.ready()
    assert client.status().leases[0].state == "held"


@pytest.mark.parametrize("how", ["kept to the end", "dropped in a function", "in a fork"])
def test_a_client_that_is_never_left_does_not_keep_its_program(
    arbiter_daemon: ArbiterProcess, how: str
) -> None:
    """The program waited for the client's thread for ever."""
    code = f"""
import os, sys
from vram_arbiter import Client
def enter():
    client = Client("careless").__enter__()
    client.acquire(vram="1GiB", unload=lambda: print("unloaded"))
    return client
kept = enter()
if {how!r} == "dropped in a function":
    del kept
    with Client("other") as other:
        assert not other.status().leases, "it was left in its place"
if {how!r} == "in a fork":
    child = os.fork()
    if child:
        os.waitpid(child, 0)
print("ends")
"""
    done = subprocess.run(
        [sys.executable, "-W", "ignore::DeprecationWarning", "-c", code],
        env=arbiter_daemon.environ,
        capture_output=True,
        text=True,
        timeout=PATIENCE_S,
    )
    assert done.returncode == 0, done.stderr
    expected = {
        "kept to the end": "ends\n",
        "dropped in a function": "unloaded\nends\n",
        "in a fork": "ends\nends\n",
    }
    assert done.stdout == expected[how], done.stderr
    assert done.stderr.count("the client 'careless' was entered and never left") == 1
    assert "Traceback" not in done.stderr


def test_closed_or_unreachable(tmp_path: Path) -> None:
    client = Client("t", endpoint=f"ipc://{tmp_path}/none.sock", connect_timeout_s=0.2)
    with pytest.raises(ArbiterUnreachable):
        client.__enter__()
    with pytest.raises(BadState):
        client.status()
