"""Replies and pushes as clients read them: every op has a type, newer fields are ignored, older
ones take defaults."""

from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.ids import Token
from vram_arbiter.schemas.wire.pushes import PUSHES, RevokePush
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.requests import REPLIES, Acquire

VIEW = {
    "lease_id": "L1-1", "token": [1, 2], "state": "loading", "consumer": "vlm", "model": "m",
    "gpu": "GPU-0", "mode": "shared",
    "priority": 50, "evictable": True, "charge_bytes": 1, "uses": 0, "pid": 7, "since_s": 0.0,
}  # fmt: skip


def test_a_grant_is_read_from_older_and_newer_arbiters() -> None:
    message = {"re": 1, "epoch": 1, "ok": True, "state": "loading", "lease": {**VIEW, "new": 1}}
    reply = from_map(REPLIES[Acquire], message)
    assert isinstance(reply, AcquireReply)
    assert (reply.lease.token, reply.lease.position, reply.lease.pinned) == (Token(1, 2), None, "")


def test_a_push_is_read_by_its_kind() -> None:
    revoke = {"push": "revoke", "seq": 1, "epoch": 1, "lease_id": "L1-1", "token": [1, 2],
    "reason": "r", "wanted_by": "w", "uses": 0, "park": False}  # fmt: skip
    order = {"by": "ops", "reason": "test"}
    push = from_map(PUSHES["revoke"], {**revoke, "deadline_in_s": 3.0, "order": order})
    assert isinstance(push, RevokePush)
    assert (push.token, push.order and push.order.by, push.uses) == (Token(1, 2), "ops", 0)
