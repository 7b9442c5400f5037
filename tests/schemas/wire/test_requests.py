"""Requests as clients of the form before sent them: the same bytes, and the daemon reads the same
object from them.

The maps are recorded: until 0.2 each was written out where a client sent it, and validated by a
class of its own.
"""

from dataclasses import MISSING, fields
from typing import Any

import msgpack
import pytest

from vram_arbiter.arbiter.rpc.codec import decode
from vram_arbiter.schemas.codec import from_map, to_map
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.ids import LeaseId, RequestId, Token, UseId
from vram_arbiter.schemas.wire import requests as w
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

ON = (LeaseId("L1-1"), Token(1, 2))
REF: dict[str, Any] = {"lease_id": "L1-1", "token": [1, 2]}
SPEC = LeaseSpec("c", "m", Footprint(5, 4, 1), ttl_s=9.0, standby=True)
PLAIN_SPEC = {
    "consumer": "c",
    "model_id": "m",
    "footprint": {"load_peak_bytes": 5, "steady_bytes": 4, "residue_bytes": 1},
    "ttl_s": 9.0,
    "standby": True,
}
HELD = {**REF, "spec": PLAIN_SPEC, "state": "held", "measured_bytes": None, "use_ids": ["u"]}
RECORDED: list[tuple[w.AnyRequest, dict[str, Any]]] = [
    (w.Hello(name="n", instance="1-a"),
     {"op": "hello", "version": 3, "name": "n", "instance": "1-a", "role": "client"}),
    (w.Acquire("n1", SPEC, 4.0),
     {"op": "acquire", "nonce": "n1", "spec": PLAIN_SPEC, "wait_timeout_s": 4.0}),
    (w.Ready(*ON), {"op": "ready", **REF, "measured_bytes": None}),
    (
        w.UseBegin(*ON, UseId("u")),
        {"op": "use_begin", **REF, "use_id": "u", "label": "", "begun": False},
    ),
    (w.UseEnd(*ON, UseId("u")), {"op": "use_end", **REF, "use_id": "u"}),
    (w.Renew((w.LeaseRef(*ON),)), {"op": "renew", "leases": [REF]}),
    (w.RevokeAck(*ON, 1.5), {"op": "revoke_ack", **REF, "safe_point_eta_s": 1.5}),
    (w.Unloading(*ON), {"op": "unloading", **REF}),
    (w.Release(*ON), {"op": "release", **REF, "exiting": False, "parked": False}),
    (w.Cancel(ON[0]), {"op": "cancel", "lease_id": "L1-1"}),
    (w.Reacquire(*ON), {"op": "reacquire", **REF, "wait_timeout_s": None}),
    (w.Reattach((w.ReattachLease(*ON, SPEC, "held", None, (UseId("u"),)),)),
     {"op": "reattach", "leases": [HELD]}),
    (w.Oom(*ON, 5), {"op": "oom", **REF, "requested_bytes": 5, "allocated_bytes": None}),
    (w.Status(), {"op": "status"}),
    (w.Status(True, after=(0, 1.5, 7)), {"op": "status", "details": True, "after": [0, 1.5, 7]}),
    (w.AskWhy("c"), {"op": "why", "consumer": "c"}),
    (w.History(3, 4, ("oom",)), {"op": "history", "after": 3, "limit": 4, "kinds": ["oom"]}),
    (w.History(before=9), {"op": "history", "before": 9}),
    (w.Subscribe(), {"op": "subscribe"}),
    (w.Evict("r", "t"), {"op": "evict", "reason": "r", "target": "t"}),
    (w.Kill("r", "t"), {"op": "kill", "reason": "r", "target": "t"}),
    (w.Pin("r", "t"), {"op": "pin", "reason": "r", "target": "t"}),
    (w.Unpin("r", "t"), {"op": "unpin", "reason": "r", "target": "t"}),
    (w.ReleaseDead("r", "t"), {"op": "release_dead", "reason": "r", "target": "t"}),
    (w.Drain("r"), {"op": "drain", "reason": "r"}),
    (w.Resume("r"), {"op": "resume", "reason": "r"}),
    (w.Prepare("c"), {"op": "prepare", "consumer": "c"}),
    (w.Demand((w.ConsumerDemand("c", 1, 2),)),
     {"op": "demand", "consumers": [{"consumer": "c", "in_flight": 1, "waiting": 2}]}),
    (w.Ping(), {"op": "ping"}),
    (w.Bye(), {"op": "bye"}),
]  # fmt: skip


def test_a_request_is_sent_and_read_as_ever() -> None:
    for request, recorded in RECORDED:
        frame = msgpack.packb({**recorded, "id": 7})
        assert msgpack.packb({**to_map(request), "id": 7}) == frame
        assert decode(frame, MESSAGE_MAX_BYTES) == (w.Envelope(RequestId(7)), request)


def test_every_op_is_recorded() -> None:
    assert {type(request) for request, _ in RECORDED} == set(w.REQUESTS.values())


def test_what_older_clients_leave_out_is_its_default() -> None:
    """A client need not say a field that has a default, nor its version a newer one's field."""
    for request, recorded in RECORDED:
        optional = {field.name for field in fields(request) if field.default is not MISSING}
        short = {key: value for key, value in recorded.items() if key not in optional}
        _, read = decode(msgpack.packb({**short, "id": 7}), MESSAGE_MAX_BYTES)
        assert read == from_map(type(request), short)


@pytest.mark.parametrize("op", ["renew", "reattach"])
def test_a_list_of_leases_ends_at_its_first_wrong_item(op: str) -> None:
    """Regression: a page of wrong ids cost the daemon an error for each."""
    with pytest.raises(Exception, match=r"leases\.0: Input should be [a-zA-Z ]+$"):
        decode(msgpack.packb({"op": op, "id": 1, "leases": [0] * 100}), MESSAGE_MAX_BYTES)
