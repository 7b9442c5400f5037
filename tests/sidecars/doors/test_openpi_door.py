"""openpi's stock client at a sidecar's door, unmodified."""

import http.client
import os
import re
import socket
import threading
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import msgpack
import pytest

from tests.sidecars.doors.conftest import GRAB, KEY, Served
from tests.support.guests import USER
from tests.support.process import Make
from tests.support.remote import Remote, wait_for_line
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.runtime.ports import free_port
from vram_arbiter.sidecars.doors.open import CONNECTIONS_MAX

pytest.importorskip("openpi_client", reason="the dependency group `stock` is not installed")
pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(400)]
ROWS, JOINTS = 12, 6


@pytest.fixture
def door(doors: dict[str, Served]) -> Served:
    return doors["openpi"]


@pytest.fixture
def connect(door: Served) -> Iterator[Callable[..., Any]]:
    from openpi_client.websocket_client_policy import WebsocketClientPolicy

    made: list[Any] = []

    def connect(key: str | None = KEY, port: int = door.port) -> Any:
        made.append(WebsocketClientPolicy("127.0.0.1", port, api_key=key))
        return made[-1]

    yield connect
    for one in made:
        one._ws.close()


def seen(level: int = 0) -> dict[str, Any]:
    import numpy as np

    return {
        "observation/images": {"front": np.full((96, 96, 3), level, np.uint8)},
        "observation/wrist": np.full((3, 96, 96), level, np.uint8),
        "observation/state": np.linspace(-1, 1, JOINTS),
        "prompt": "grab the red cube",
    }


def native(door: Served, observation: dict[str, Any]) -> Any:
    """The answer of the sidecar's own wire."""
    ours = {
        "observation.images.front": observation["observation/images"]["front"],
        "observation.images.wrist": observation["observation/wrist"].transpose(1, 2, 0),
        "observation.state": observation["observation/state"],
        "task": observation["prompt"],
    }
    data = npy.pack({"observation": ours})
    answer = door.ask(endpoint="get_action", whole_chunk=True, data=data)
    return npy.unpack(answer["action"])


@pytest.mark.nightly
def test_a_robot_reaches_the_door_through_its_tunnel(
    connect: Callable[..., Any], door: Served, make_arbiter: Make, tmp_path: Path
) -> None:
    with Remote(make_arbiter, tmp_path) as remote:
        remote.authorize(door.port)
        # the door lets in whoever may open its socket: by the account, which sshd's namespace has
        os.chown(door.arbiter.runtime / "second.openpi", remote.sshd.uid(USER), -1)
        here = free_port()
        keeper = remote.up("--door", f"{here}:{door.port}")
        assert connect(port=here).infer(seen())["actions"].shape == (ROWS, JOINTS)

        remote.sshd.kill(USER)
        wait_for_line(keeper, "is up")
        assert connect(port=here).infer(seen())["actions"].shape == (ROWS, JOINTS)


def test_a_chunk_is_answered_and_played_row_by_row(
    connect: Callable[..., Any], door: Served
) -> None:
    import numpy as np
    from openpi_client.action_chunk_broker import ActionChunkBroker

    client = connect()
    metadata = client.get_server_metadata()
    assert (metadata["skill"], metadata["horizon"], len(metadata["reset_pose"])) == (GRAB, ROWS, 6)
    first, second = (native(door, seen(level)) for level in (0, 200))
    answer = client.infer(seen())
    assert answer["server_timing"]["infer_ms"] > 0
    np.testing.assert_array_equal(answer["actions"], first)
    broker = ActionChunkBroker(client, ROWS)
    rows = [broker.infer(seen(0 if step < ROWS else 200))["actions"] for step in range(2 * ROWS)]
    np.testing.assert_array_equal(rows, np.concatenate([first, second]))
    assert (first != second).any()


def test_an_error_is_a_text_and_the_client_goes_on(connect: Callable[..., Any]) -> None:
    import numpy as np

    client = connect()
    for wrong, told in (
        ({}, "bad_request: the observation has no state"),
        (seen() | {"observation/images": {}}, "the observation lacks observation.images.front"),
        (seen() | {"observation/state": np.zeros(3)}, r"observation.state must have shape \(6,\)"),
        (seen() | {"observation/state": np.full(6, np.nan)}, "numbers that are not finite"),
        (seen() | {"observation/state": "here"}, "the observation has no state"),
    ):
        with pytest.raises(RuntimeError, match=told):
            client.infer(wrong)
    assert client.infer(seen())["actions"].shape == (ROWS, JOINTS)


def test_only_a_key_of_the_file_is_let_in(connect: Callable[..., Any], door: Served) -> None:
    from websockets.exceptions import InvalidStatus

    for key in (None, "wrong", KEY[:-1], KEY + "x", "ü"):
        with pytest.raises((InvalidStatus, UnicodeError)):
            connect(key)
    connect("another-key")
    asked = http.client.HTTPConnection("127.0.0.1", door.port, timeout=PATIENCE_S)
    asked.request("GET", "/healthz")
    answer = asked.getresponse()
    assert (answer.status, answer.read()) == (200, b"OK\n")
    asked.close()


def test_an_evicted_model_comes_back_for_the_next_observation(
    connect: Callable[..., Any], door: Served
) -> None:
    client = connect()
    answers: list[Any] = []
    with door.evicted():
        asking = threading.Thread(target=lambda: answers.append(client.infer(seen())))
        asking.start()
        until(lambda: door.ask(endpoint="ping").get("wanted"))
        assert client._ws.ping().wait(PATIENCE_S), "a client without it hangs up"
        assert not answers
    asking.join(PATIENCE_S)
    assert answers[0]["actions"].shape == (ROWS, JOINTS)


def flood(socket: Any) -> None:
    """Send messages that are too big until the door hangs up."""
    while True:
        socket.send(bytes(24 * MIB))
        socket.recv(PATIENCE_S)


def test_attackers_are_refused_while_a_robot_is_served(
    connect: Callable[..., Any], door: Served
) -> None:
    from websockets.exceptions import ConnectionClosed

    client, before = connect(), door.rss_bytes()
    array = {b"__ndarray__": True, b"data": b"", b"dtype": "<f8", b"shape": [10**6, 10**6]}
    for hostile, told in (
        (msgpack.packb([1]), "bad_frame: expected a msgpack map"),
        (b"\xdf\xff\xff\xff\xff", "bad_frame|message_too_large"),
        (b"\x81\xa1a" + b"\x91" * 900 + b"\xc0", "bad_frame|bad_request"),
        (b"\x81\xa1a\xdd\x00\x0f\xff\xff" + b"\x80" * (MIB - 1), "message_too_large"),
        (msgpack.packb({"state": array}), "bad_request: an array of 8000000000000 bytes"),
        (msgpack.packb({"state": array | {b"dtype": "|O"}}), "not of numbers"),
        ("a text", "bad_frame"),
    ):
        peer = connect()
        peer._ws.send(hostile)
        assert re.search(told, answered := peer._ws.recv(PATIENCE_S)), answered
        assert client.infer(seen())["actions"].shape == (ROWS, JOINTS)
    with pytest.raises((ConnectionClosed, OSError)):
        flood(connect()._ws)
    crowd = [socket.create_connection(("127.0.0.1", door.port)) for _ in range(4 * CONNECTIONS_MAX)]
    assert client.infer(seen())["actions"].shape == (ROWS, JOINTS)
    for one in crowd:
        one.close()
    assert door.rss_bytes() - before < 128 * MIB
    assert "Traceback" not in door.log.read_text()


def test_one_observation_at_a_time(connect: Callable[..., Any], door: Served) -> None:
    from openpi_client import msgpack_numpy
    from websockets.exceptions import ConnectionClosed

    client = connect()
    with door.evicted():
        for _ in range(2):
            client._ws.send(msgpack_numpy.packb(seen()))
        with pytest.raises(ConnectionClosed, match="one observation at a time"):
            client._ws.recv(PATIENCE_S)
