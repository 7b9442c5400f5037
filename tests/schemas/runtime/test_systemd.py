"""Notifications on a real datagram socket, and silence without one."""

import os
import select
import socket
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from vram_arbiter.schemas.runtime.systemd import Notifier


@pytest.fixture
def manager() -> Iterator[tuple[str, socket.socket]]:
    with (
        tempfile.TemporaryDirectory(prefix="va") as folder,
        socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening,
    ):
        address = str(Path(folder) / "n")
        listening.bind(address)
        listening.settimeout(10)
        yield address, listening


def test_messages_arrive(manager: tuple[str, socket.socket]) -> None:
    address, listening = manager
    notifier = Notifier({"NOTIFY_SOCKET": address})
    notifier.ready("serving")
    notifier.status("busy")
    notifier.watchdog()
    notifier.stopping("bye")
    assert [listening.recv(1000).decode() for _ in range(4)] == [
        f"READY=1\nSTATUS=serving\nMAINPID={os.getpid()}",
        "STATUS=busy",
        "WATCHDOG=1",
        "STOPPING=1\nSTATUS=bye",
    ]


def test_an_abstract_address() -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as listening:
        listening.bind(f"\0va-test-{os.getpid()}")
        listening.settimeout(10)
        Notifier({"NOTIFY_SOCKET": f"@va-test-{os.getpid()}"}).watchdog()
        assert listening.recv(100) == b"WATCHDOG=1"


def test_a_manager_that_does_not_listen_stops_nobody(manager: tuple[str, socket.socket]) -> None:
    address, listening = manager
    Notifier({}).ready("x")
    assert Notifier({}).status("nobody is to be told")
    Notifier({"NOTIFY_SOCKET": "/nonexistent/socket"}).ready("x")
    notifier = Notifier({"NOTIFY_SOCKET": address})
    for _ in range(5000):  # its queue is full long before
        notifier.watchdog()
    assert not notifier.status("has to be said again")
    while listening.recv(100) == b"WATCHDOG=1" and select.select([listening], [], [], 0)[0]:
        pass
    assert notifier.status("said")
    assert listening.recv(100) == b"STATUS=said"
    listening.close()
    notifier.watchdog()


@pytest.mark.parametrize(
    ("environ", "watchdog_s"),
    [
        ({}, None),
        ({"WATCHDOG_USEC": "0"}, None),
        ({"WATCHDOG_USEC": "soon"}, None),
        ({"WATCHDOG_USEC": "1500000"}, 1.5),
        ({"WATCHDOG_USEC": "1500000", "WATCHDOG_PID": str(os.getpid())}, 1.5),
        ({"WATCHDOG_USEC": "1500000", "WATCHDOG_PID": "1"}, None),
    ],
)
def test_the_watchdog_is_for_the_process_that_is_named(
    environ: dict[str, str], watchdog_s: float | None
) -> None:
    assert Notifier(environ).watchdog_s == watchdog_s
