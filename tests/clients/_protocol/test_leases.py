"""Leases that the client's protocol holds: renewal, fencing, operations, reattachment."""

import pytest

from tests.support.protocol_wire import Wire, view
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import HELLO_TIMEOUT_S
from vram_arbiter.schemas.errors import BadState, LeaseExpired, LeaseLost, StaleToken
from vram_arbiter.schemas.wire.requests import Unloading


def test_renewal_every_third_of_the_shortest_ttl(link: Wire) -> None:
    record = link.hold()
    link.tick(2.9)
    link.sent()
    link.tick(0.1)
    renew = next(m for m in link.sent() if m["op"] == "renew")
    assert renew["leases"] == [{"lease_id": "L1-1", "token": [1, 2]}]
    asked_at = link.now
    link.now += 1.0
    link.reply(renew, alive=["L1-1"], gone=[])
    # the arbiter counts from the message it heard, not from our hearing of it
    assert record.confirmed_at == asked_at


def test_a_renewal_tells_that_a_lease_is_gone(link: Wire) -> None:
    record = link.hold()
    link.tick(3.0)
    renew = next(m for m in link.sent() if m["op"] == "renew")
    link.reply(renew, alive=[], gone=[{"lease_id": "L1-1", "error": {"code": "lease_expired"}}])
    (gone,) = link.told()
    assert isinstance(gone, r.Gone)
    assert gone.record is record
    assert isinstance(gone.error, LeaseExpired)
    assert not gone.fenced
    assert link.holdings.held == {}


def test_fenced_after_ttl_and_grace_without_a_word(link: Wire) -> None:
    record = link.hold()
    link.connection.contact_lost("test")
    link.told()
    assert link.protocol.next_deadline() == pytest.approx(link.now + 14.0)
    link.tick(13.9)
    assert link.told() == []
    link.tick(0.1)
    (gone,) = link.told()
    assert isinstance(gone, r.Gone)
    assert gone.fenced
    assert gone.record is record
    assert isinstance(gone.error, LeaseLost)


def test_a_use_that_waits_for_the_arbiter_ends_with_its_lease(link: Wire) -> None:
    """Regression: after a kill of the arbiter the lease was fenced at TTL + grace, and `use_begin`
    went on waiting for its own 30 s."""
    record = link.hold()
    link.connection.contact_lost("test")
    begun = link.holdings.use_begin(record, "u1", "", link.now)
    link.told()
    link.tick(14.0)
    gone, failed = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(failed, r.Failed)
    assert failed.request_id == begun
    assert failed.error is gone.error
    link.greet()
    assert link.sent() == [], "nothing of it is said again"


def test_a_server_that_answers_pings_but_no_renewals_does_not_keep_leases_alive(link: Wire) -> None:
    link.hold()
    for _ in range(14):
        link.tick(1.0)
        for message in link.sent():
            if message["op"] == "ping":
                link.reply(message)
    assert any(isinstance(event, r.Gone) and event.fenced for event in link.told())


def test_lost_push(link: Wire) -> None:
    link.hold()
    link.push("lost", lease_id="L1-1", token=[1, 1], error={"code": "lease_lost"})
    assert link.told() == []  # an older grant's
    link.push("lost", lease_id="L1-1", token=[1, 2], error={"code": "lease_lost"})
    assert isinstance(link.told()[0], r.Gone)


def test_an_operation_on_a_lease_that_is_gone_tells_both(link: Wire) -> None:
    record = link.hold()
    link.holdings.ask(record, Unloading(record.lease_id, record.token), link.now)
    link.refuse(link.one("unloading"), "stale_token")
    gone, failed = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(failed, r.Failed)
    assert isinstance(failed.error, StaleToken)


def test_a_refused_use_does_not_count(link: Wire) -> None:
    record = link.hold()
    link.holdings.use_begin(record, "u1", "goal", link.now)
    assert record.uses == {"u1"}
    link.refuse(link.one("use_begin"), "lease_revoking")
    assert record.uses == set()
    assert link.holdings.held


def test_each_revoke_is_told(link: Wire) -> None:
    link.hold()
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=1)
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=0)
    first, second = link.told()
    assert isinstance(first, r.RevokeAsked)
    assert isinstance(second, r.RevokeAsked)
    assert (first.push.uses, second.push.uses) == (1, 0)
    link.push("revoke", lease_id="L1-1", token=[1, 7], uses=0)
    assert link.told() == []


def test_a_withdrawn_revoke_is_told_once(link: Wire) -> None:
    record = link.hold()
    link.push("revoke_withdrawn", lease_id="L1-1", token=[1, 2])
    assert link.told() == [], "it was not revoked"
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=1)
    link.push("revoke_withdrawn", lease_id="L1-1", token=[1, 7])
    link.push("revoke_withdrawn", lease_id="L1-1", token=[1, 2])
    _, told = link.told()
    assert isinstance(told, r.RevokeWithdrawn)
    assert told.record is record
    assert record.withdrawn
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=1)
    assert not record.withdrawn, "and revoked anew"


@pytest.mark.parametrize(("state", "stays"), [("held", True), ("revoking", False)])
def test_a_reattached_holder_learns_whether_it_is_still_revoked(
    link: Wire, state: str, stays: bool
) -> None:
    """The withdrawal may have been lost with the connection, or the revoke with the daemon."""
    record = link.hold()
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=1)
    link.told()
    link.reply(
        link.reconnect(),
        leases=[{"lease_id": "L1-1", "kept": True, "lease": view("L1-1", [1, 2], state)}],
    )
    told = [event for event in link.told() if isinstance(event, r.RevokeWithdrawn)]
    assert (bool(told), record.withdrawn) == (stays, stays)
    assert record.revoke is not None, "until the holder has heard of it"


def test_a_released_lease_is_neither_renewed_nor_reattached(link: Wire) -> None:
    record = link.hold()
    link.holdings.release(record, False, link.now, 5.0)
    link.one("release")
    link.tick(3.0)
    assert all(message["op"] == "ping" for message in link.sent())


def test_reattachment_says_what_is_held_and_used(link: Wire) -> None:
    record = link.hold()
    link.holdings.use_begin(record, "u1", "x", link.now)
    link.reply(link.one("use_begin"))
    link.told()
    loading = link.grant("n2", "L1-3", 4)
    link.told()
    reattach = link.reconnect()
    shown = [
        (e["lease_id"], e["state"], e["measured_bytes"], e["use_ids"]) for e in reattach["leases"]
    ]
    assert shown == [("L1-1", "held", 4, ["u1"]), ("L1-3", "loading", None, [])]
    assert link.connection.phase == "reattaching"
    link.epoch = 2
    link.reply(
        reattach,
        leases=[
            {"lease_id": "L1-1", "kept": True, "lease": view(token=[1, 2], state="held")},
            {"lease_id": "L1-3", "kept": False, "error": {"code": "lease_expired"}},
        ],
    )
    gone, up = link.told()
    assert isinstance(gone, r.Gone)
    assert gone.record is loading
    assert isinstance(up, r.Up)
    assert list(link.holdings.held) == ["L1-1"]


def test_reattachment_renews(link: Wire) -> None:
    record = link.hold()
    link.now += 10.0
    reattach = link.reconnect()
    link.reply(reattach, leases=[{"lease_id": "L1-1", "kept": True}])
    assert record.confirmed_at == link.now


def test_a_reattachment_without_an_answer_starts_over(link: Wire) -> None:
    link.hold()
    link.reconnect()
    link.tick(HELLO_TIMEOUT_S)
    assert isinstance(link.told()[0], r.ContactLost)


def test_a_ready_on_the_way_is_said_again_and_counts_only_then(link: Wire) -> None:
    record = link.grant()
    link.holdings.ready(record, 4, link.now)
    link.one("ready")
    reattach = link.reconnect()
    assert reattach["leases"][0]["state"] == "loading"
    link.reply(reattach, leases=[{"lease_id": "L1-1", "kept": True}])
    link.reply(link.one("ready"))
    assert record.held


def test_bad_state_is_no_loss(link: Wire) -> None:
    record = link.hold()
    link.holdings.ask(record, Unloading(record.lease_id, record.token), link.now)
    link.refuse(link.one("unloading"), "bad_state", uses=1)
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert isinstance(failed.error, BadState)
    assert link.holdings.held
