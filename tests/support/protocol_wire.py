"""For tests of the client's protocol: both ends of its wire, with an arbiter that says what the
test tells it to."""

from collections.abc import Mapping
from typing import Any

import msgpack

from vram_arbiter.arbiter.rpc.codec import decode
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.protocol import ClientProtocol
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

SPEC = LeaseSpec(consumer="detector", model_id="m", ttl_s=9.0, footprint=Footprint(5, 4, 1))
WELCOME = {
    "version": d.WIRE_VERSION,
    "boot_id": "b",
    "server": "s",
    "role": "client",
    "heartbeat_s": 2.0,
    "grace_s": 5.0,
}


def view(
    lease_id: str = "L1-1", token: list[int] | None = None, state: str = "loading"
) -> dict[str, Any]:
    return {
        "lease_id": lease_id,
        "token": token,
        "state": state,
        "gpu": "GPU-1",
        "consumer": "detector",
        "model": "m",
        "mode": "shared",
        "priority": 50,
        "pid": 1,
        "evictable": True,
        "charge_bytes": 5,
        "uses": 0,
        "since_s": 0.0,
    }


PLAIN: Mapping[str, Mapping[str, Any]] = {
    "ping": {"server": "s"},
    "status": {
        "phase": "serving",
        "uptime_s": 1.0,
        "gpus": [],
        "leases": [],
        "clients": 1,
        "totals": {"leases": 0, "waiting": 0},
        "drained": "",
        "problems": [],
        "host_ram": {"budget_bytes": 0, "parked_bytes": 0},
    },
    "ready": {"lease": view()},
    "use_begin": {"uses": 1},
    "use_end": {"uses": 0},
    "revoke_ack": {"state": "revoking"},
    "unloading": {"state": "unloading"},
    "cancel": {"state": "over"},
    "release": {"state": "verifying", "next": "released"},
    "oom": {"learnt_load_peak_bytes": None},
}
"""What the arbiter answers where a test does not say it."""
REVOKE: dict[str, Any] = {"wanted_by": "", "deadline_in_s": 30.0, "uses": 0, "park": False}


class Wire:
    """Both ends: the protocol and an arbiter that says what the test tells it to. Every request
    must be valid on the wire."""

    def __init__(self) -> None:
        self.protocol = ClientProtocol(name="test", instance="1-a")
        self.connection = self.protocol.connection
        self.waits = self.protocol.waits
        self.holdings = self.protocol.holdings
        self.foreign_uses = self.protocol.foreign_uses
        self.epoch = 1
        self.now = 100.0

    def sent(self) -> list[dict[str, Any]]:
        messages, self.connection.outgoing = self.connection.outgoing, []
        frames = [pack(message) for message in messages]
        for frame in frames:
            decode(frame, d.MESSAGE_MAX_BYTES)
        return [msgpack.unpackb(frame) for frame in frames]

    def told(self) -> list[r.Event]:
        events, self.connection.events = self.connection.events, []
        return events

    def one(self, op: str) -> dict[str, Any]:
        (message,) = self.sent()
        assert message["op"] == op
        return message

    def said(self, op: str) -> list[dict[str, Any]]:
        return [message for message in self.sent() if message["op"] == op]

    def reply(self, request: Mapping[str, Any], **body: Any) -> None:
        self.connection.receive(
            {
                "re": request["id"],
                "epoch": self.epoch,
                "ok": True,
                **PLAIN.get(request["op"], {}),
                **body,
            },
            self.now,
        )

    def refuse(self, request: Mapping[str, Any], code: str, **details: Any) -> None:
        error = {"code": code, "message": "no", "hint": "", "details": details}
        self.connection.receive(
            {"re": request["id"], "epoch": self.epoch, "ok": False, "error": error}, self.now
        )

    def push(self, kind: str, **body: Any) -> None:
        plain = REVOKE if kind == "revoke" else {}
        head = {"push": kind, "seq": 1, "epoch": self.epoch}
        self.connection.receive({**head, **plain, **body}, self.now)

    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.protocol.tick(self.now)

    def greet(self) -> None:
        """Hello until up, without leases to reattach."""
        self.connection.connected(self.now)
        hello = self.one("hello")
        self.reply(hello, **WELCOME)
        assert r.Up(self.epoch) in self.told()

    def grant(self, nonce: str = "n1", lease_id: str = "L1-1", serial: int = 2) -> r.LeaseRecord:
        self.waits.acquire(nonce, SPEC, self.now)
        self.reply(self.one("acquire"), state="loading", lease=view(lease_id, [1, serial]))
        (granted,) = self.told()
        assert isinstance(granted, r.Granted)
        return granted.record

    def hold(self, **names: Any) -> r.LeaseRecord:
        record = self.grant(**names)
        self.holdings.ready(record, 4, self.now)
        self.reply(self.one("ready"))
        self.told()
        return record

    def reconnect(self) -> dict[str, Any]:
        """Lose contact, say hello again; returns the reattach request."""
        self.connection.contact_lost("test")
        assert self.told() == [r.ContactLost("test")]
        self.connection.connected(self.now)
        self.reply(self.one("hello"), **WELCOME)
        return self.one("reattach")


def evict(
    link: Wire, record: r.LeaseRecord, asleep: str = "standby", then: str | None = None
) -> None:
    """The holder is asked, lets go, and hears how the lease waits."""
    link.push("revoke", lease_id=record.lease_id, token=list(record.token), park=True)
    link.holdings.release(record, False, link.now, 5.0, asleep=asleep)
    message = link.one("release")
    assert message["parked"] == (asleep == "parked")
    link.reply(message, state="verifying", next=asleep if then is None else then)
    link.told()
