"""No bytes make the codec raise anything but a typed, answerable error."""

from typing import Any

import msgpack
import pytest

from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import VALUES_MAX
from vram_arbiter.schemas.errors import BadFrame, BadRequest, MessageTooLarge, UnknownOp
from vram_arbiter.schemas.ids import RequestId, Token
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.pushes import RevokeWithdrawnPush
from vram_arbiter.schemas.wire.replies import UsesReply
from vram_arbiter.schemas.wire.requests import Acquire, Envelope, Ping, Reattach
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

LIMIT = 1 << 20


def undecodable(payload: bytes) -> codec.Undecodable:
    with pytest.raises(codec.Undecodable) as raised:
        codec.decode(payload, LIMIT)
    return raised.value


def pack(**message: Any) -> bytes:
    packed: bytes = msgpack.packb(message)
    return packed


def test_a_request_is_read() -> None:
    assert codec.decode(pack(op="ping", id=7), LIMIT) == (Envelope(RequestId(7)), Ping())


def test_a_nested_request_is_read() -> None:
    spec = {
        "consumer": "c",
        "model_id": "m",
        "footprint": {"load_peak_bytes": 5, "steady_bytes": 4},
    }
    _, request = codec.decode(pack(op="acquire", id=1, nonce="n", spec=spec), LIMIT)
    assert isinstance(request, Acquire)
    assert request.spec.footprint.load_peak_bytes == 5


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xc1",  # never used by msgpack
        b"not msgpack at all",
        msgpack.packb([1, 2]),
        msgpack.packb(None),
        msgpack.packb({"op": "ping", "id": 1}) + b"\x00",  # something behind the message
        msgpack.packb({"op": "ping", "id": 1})[:-1],  # torn
        b"\x91" * 2000,  # nested deeper than any stack
        b"\x81\x01\x02",  # a key that is no text
        b"\xa2\xff\xfe",  # text that is no UTF-8
        b"\xdd\xff\xff\xff\xff",  # a list that claims four billion items
    ],
)
def test_what_is_no_map_is_a_bad_frame(payload: bytes) -> None:
    bad = undecodable(payload)
    assert isinstance(bad.error, BadFrame)
    assert bad.request_id is None


def test_an_oversized_message_names_the_limit() -> None:
    bad = undecodable(b"\x00" * (LIMIT + 1))
    assert isinstance(bad.error, MessageTooLarge)
    assert bad.error.details == {"size_bytes": LIMIT + 1, "limit_bytes": LIMIT}


def test_an_unknown_op_lists_the_known_ones() -> None:
    bad = undecodable(pack(op="explode", id=3))
    assert isinstance(bad.error, UnknownOp)
    assert "acquire" in bad.error.details["known"]
    assert bad.request_id == 3


def test_a_long_unknown_op_is_not_echoed_at_length() -> None:
    assert len(undecodable(pack(op="x" * 100_000, id=3)).error.message) < 200


def test_wrong_fields_are_listed_by_name() -> None:
    spec = {"consumer": "", "model_id": "m", "footprint": {"load_peak_bytes": -1}, "colour": "red"}
    bad = undecodable(pack(op="acquire", id=9, nonce="n", spec=spec))
    assert isinstance(bad.error, BadRequest)
    assert bad.request_id == 9
    fields = {field["field"] for field in bad.error.details["fields"]}
    assert fields == {
        "spec.consumer",
        "spec.footprint.load_peak_bytes",
        "spec.footprint.steady_bytes",
        "spec.colour",
    }


def test_many_wrong_fields_make_a_short_reply() -> None:
    bad = undecodable(pack(op="ping", id=1, **{f"extra{n}": n for n in range(codec.KEYS_MAX - 2)}))
    assert isinstance(bad.error, BadRequest)
    assert len(bad.error.details["fields"]) == codec.FIELDS_MAX
    assert f"{codec.KEYS_MAX - 3} more" in bad.error.message


def test_a_megabyte_of_unknown_keys_is_not_built() -> None:
    """Regression: it stopped the loop for 0.7 to 4.3 s: one validation error per key."""
    bad = undecodable(pack(op="ping", id=1, **{f"k{n:06d}": 0 for n in range(100_000)}))
    assert isinstance(bad.error, MessageTooLarge)
    assert bad.error.details["limit_values"] == VALUES_MAX


def test_a_client_with_all_its_leases_and_many_uses_reattaches() -> None:
    """The limit of values must not refuse what an honest client holds: then its leases would
    expire."""
    size = {"load_peak_bytes": 5, "steady_bytes": 4, "residue_bytes": 1}
    spec = to_map(LeaseSpec(consumer="c", model_id="m", footprint=Footprint(**size)))
    lease = {"lease_id": "L", "token": [1, 1], "state": "held", "spec": spec, "measured_bytes": 4}
    leases = [
        {**lease, "use_ids": [f"use-{n}" for n in range(16)]}
        for _ in range(d.LEASES_PER_CLIENT_MAX)
    ]
    _, request = codec.decode(pack(op="reattach", id=1, leases=leases), LIMIT)
    assert isinstance(request, Reattach)
    assert len(request.leases) == d.LEASES_PER_CLIENT_MAX


@pytest.mark.parametrize("request_id", [-1, 1 << 53, "one", None, 1.5])
def test_an_unusable_id_is_answered_with_null(request_id: object) -> None:
    bad = undecodable(pack(op="ping", id=request_id))
    assert isinstance(bad.error, BadRequest)
    assert bad.request_id is None


def test_a_request_without_op_is_a_bad_request() -> None:
    assert isinstance(undecodable(pack(id=1)).error, BadRequest)


def test_replies_have_the_shape_of_the_wire() -> None:
    reply = codec.reply(4, 2, UsesReply(1))
    assert msgpack.unpackb(reply) == {"re": 4, "epoch": 2, "ok": True, "uses": 1}
    error = {"code": "bad_frame", "message": "m", "hint": "h", "details": {"a": 1}}
    refusal = codec.refusal(None, 2, ErrorView("bad_frame", "m", "h", {"a": 1}))
    assert msgpack.unpackb(refusal) == {"re": None, "epoch": 2, "ok": False, "error": error}
    push = codec.push(8, 2, RevokeWithdrawnPush("L1-1", Token(1, 2)))
    assert msgpack.unpackb(push) == {
        "push": "revoke_withdrawn",
        "lease_id": "L1-1",
        "token": [1, 2],
        "seq": 8,
        "epoch": 2,
    }
