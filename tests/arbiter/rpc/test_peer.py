"""Identity comes from the kernel and is read strictly."""

import os
import subprocess
import sys

import pytest

from arbiter.rpc.peer import Credentials, group_id, identify, is_operator, parse_peer_address, start_ticks
from schemas.errors import NotPermitted
from schemas.ids import ProcessKey


def test_the_address_is_read_from_the_right() -> None:
    assert parse_peer_address("localhost:1000:1001:42") == Credentials(1000, 1001, 42)
    assert parse_peer_address("a:b::c:1:2:3") == Credentials(1, 2, 3)


@pytest.mark.parametrize(
    "text",
    ["", "localhost", "127.0.0.1", "localhost:1:2", "localhost:1:2:", "localhost:1:2:-3", "localhost:1:2:0x3",
     "localhost:1:2: 3", "localhost:1:2:٣", "localhost:0:0:0", "1:2:3"],
)  # fmt: skip
def test_anything_else_is_refused(text: str) -> None:
    with pytest.raises(ValueError):
        parse_peer_address(text)


def test_start_ticks_of_a_process_with_a_nasty_name() -> None:
    script = (
        "import sys; open('/proc/self/comm', 'w').write(') R 1 2 ('); print(flush=True); sys.stdin.read()"
    )
    with subprocess.Popen(
        [sys.executable, "-c", script], stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as child:
        assert child.stdout is not None
        child.stdout.readline()
        ticks = start_ticks(child.pid)
        own = start_ticks(os.getpid())
        assert ticks is not None
        assert own is not None
        assert ticks >= own
        child.communicate()
    assert start_ticks(child.pid) is None


def test_a_living_peer_is_identified_with_its_start_time() -> None:
    peer = identify(f"localhost:{os.getuid()}:{os.getgid()}:{os.getpid()}")
    ticks = start_ticks(os.getpid())
    assert ticks is not None
    assert peer.process == ProcessKey(os.getpid(), ticks)


def test_a_peer_of_another_pid_namespace_is_told_what_to_do() -> None:
    """The kernel says pid 0 of a process that cannot be seen from here."""
    with pytest.raises(NotPermitted, match="another pid namespace") as refused:
        identify("localhost:1000:1000:0")
    assert "--pid=host" in refused.value.hint


def test_a_dead_or_unknown_peer_is_not_permitted() -> None:
    with subprocess.Popen([sys.executable, "-c", ""]) as child:
        child.wait()
    for address in (f"localhost:0:0:{child.pid}", "", "127.0.0.1:5555"):
        with pytest.raises(NotPermitted):
            identify(address)


def test_operators_are_root_the_same_user_and_the_group() -> None:
    group = group_id("daemon")
    assert group is not None
    assert is_operator(Credentials(0, 0, 1), None)
    assert is_operator(Credentials(os.getuid(), 0, 1), None)
    assert not is_operator(Credentials(54_321, 54_321, 1), None)
    assert not is_operator(Credentials(54_321, 54_321, 1), group)
    assert is_operator(Credentials(54_321, group, 1), group)
    assert is_operator(Credentials(1, 54_321, 1), group)  # user `daemon` by its account
    assert group_id("no-such-group-here") is None
