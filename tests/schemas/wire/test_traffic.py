"""Recorded traffic with a real daemon, in both directions, against the published JSON Schemas.

The schemas are made from the types and the types encode the messages: only a second implementation
of JSON Schema on real frames shows that the published documents say what is on the wire.
"""

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter import schemas
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.wire import requests
from vram_arbiter.schemas.wire.pushes import PUSHES

jsonschema = pytest.importorskip("jsonschema")
pytestmark = pytest.mark.e2e

WIRE = json.loads((Path(schemas.__file__).parent / "json/wire.json").read_text("utf-8"))
ENVELOPE = frozenset({"re", "ok", "epoch"})
REPLIES = {op: requests.REPLIES[cls] for op, cls in requests.REQUESTS.items()}


class RecordedClient(WireClient):
    """A bare client that keeps every message of both directions."""

    def __init__(self, endpoint: str) -> None:
        super().__init__(endpoint)
        self.ops: dict[int, str] = {}
        self.messages: list[tuple[str, dict[str, Any]]] = []

    def send(self, op: str, **fields: Any) -> int:
        request_id = super().send(op, **fields)
        self.ops[request_id] = op
        return request_id

    def send_raw(self, payload: bytes) -> None:
        import msgpack

        request = msgpack.unpackb(payload)
        self.messages.append((requests.REQUESTS[request["op"]].__name__, request))
        super().send_raw(payload)

    def receive(self, timeout_s: float = 60.0) -> dict[str, Any] | None:
        message = super().receive(timeout_s)
        if message is None:
            return None
        if "push" in message:
            self.messages.append((PUSHES[message["push"]].__name__, message))
        elif message["ok"]:
            op = self.ops[message["re"]]
            body = {key: value for key, value in message.items() if key not in ENVELOPE}
            if "epoch" in REPLIES[op].__dataclass_fields__:
                body["epoch"] = message["epoch"]
            self.messages.append((REPLIES[op].__name__, body))
        else:
            self.messages.append(("ErrorView", message["error"]))
        return message


def violations(name: str, message: dict[str, Any]) -> list[str]:
    """Return what a validator finds wrong with a message of a type."""
    validator = jsonschema.Draft202012Validator({**WIRE, "$ref": f"#/$defs/{name}"})
    return [
        f"{name}: {error.json_path}: {error.message}" for error in validator.iter_errors(message)
    ]


@pytest.fixture
def recording(arbiter_daemon: ArbiterProcess) -> Iterator[Callable[..., RecordedClient]]:
    made: list[RecordedClient] = []

    def connect(**hello: Any) -> RecordedClient:
        client = RecordedClient(arbiter_daemon.endpoint)
        made.append(client)
        client.hello(f"client-{len(made)}", **hello)
        return client

    yield connect
    for client in made:
        client.close()


def everything(connect: Callable[..., RecordedClient]) -> list[RecordedClient]:
    """Use every op of the wire once at least, and cause every push."""
    holder, other, operator = connect(), connect(), connect(role="operator")
    operator.ask("subscribe")
    lease = holder.granted("detector", 5 * GIB, standby=True)
    ref = {"lease_id": lease["lease_id"], "token": lease["token"]}
    holder.ask("ready", **ref, measured_bytes=5 * GIB)
    holder.ask("use_begin", **ref, use_id="u1", label="detect")
    holder.ask("use_end", **ref, use_id="u1")
    holder.ask("renew", leases=[ref])
    holder.ask("oom", **ref, requested_bytes=GIB, allocated_bytes=5 * GIB)
    assert other.acquire("chat", GIB, gpu="no-such-gpu")["ok"] is False
    other.ask("demand", consumers=[{"consumer": "chat", "in_flight": 1, "waiting": 2}])
    for op in ("status", "ping"):
        other.ask(op)
    other.ask("history", after=0, limit=100)
    other.ask("prepare", consumer="client-1")
    holder.push("prepare")
    for action in ("pin", "unpin"):
        operator.ask(action, target=lease["lease_id"], reason="test")
    operator.ask("release_dead", target=lease["lease_id"], reason="test")
    operator.ask("drain", reason="test")
    operator.ask("resume", reason="test")
    given_up = other.acquire("grab", 6 * GIB, nonce="first")
    other.ask("why", consumer="grab")
    other.ask("cancel", lease_id=given_up["lease"]["lease_id"])
    other.acquire("grab", 6 * GIB, nonce="second", wait_timeout_s=0.01)
    other.push("denied")
    waiting = other.acquire("grab", 6 * GIB, nonce="third")
    holder.push("revoke")
    holder.ask("revoke_ack", **ref, safe_point_eta_s=0.1)
    holder.ask("unloading", **ref)
    holder.ask("release", **ref)
    granted = other.push("granted")["lease"]
    assert granted["lease_id"] == waiting["lease"]["lease_id"]
    holder.ask("reacquire", **ref, wait_timeout_s=0.01)
    operator.ask("evict", target="grab", reason="test")
    held = {"lease_id": granted["lease_id"], "token": granted["token"]}
    footprint = {"load_peak_bytes": 6 * GIB, "steady_bytes": 6 * GIB, "residue_bytes": 0}
    spec = {"consumer": "grab", "model_id": "grab", "footprint": footprint, "ttl_s": 600.0}
    other.ask("reattach", leases=[{**held, "spec": spec, "state": "loading"}])
    operator.ask("kill", target="no-such-consumer", reason="test")
    operator.push("event")
    other.ask("bye")
    return [holder, other, operator]


def test_every_message_is_valid_under_the_published_schemas(
    recording: Callable[..., RecordedClient],
) -> None:
    clients = everything(recording)
    messages = [message for client in clients for message in client.messages]
    assert {message["op"] for _, message in messages if "op" in message} == set(REPLIES)
    seen = {name for name, _ in messages}
    assert {cls.__name__ for cls in REPLIES.values()} <= seen
    assert {"RevokePush", "GrantedPush", "DeniedPush", "EventPush", "ErrorView"} <= seen
    found = [problem for name, message in messages for problem in violations(name, message)]
    assert not found, "\n".join(found)


def test_the_validator_refuses_what_the_schemas_do_not_allow() -> None:
    assert violations("Ping", {"op": "ping", "id": 1}) == []
    assert violations("Ping", {"op": "ping"})
    assert violations("RevokePush", {"push": "revoke", "lease_id": 7})
