"""Leases that leave and come back, in the client's protocol: standby, parked, wanted again."""

from typing import Any

from tests.support.protocol_wire import WELCOME, Wire, evict, view
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.schemas.errors import ArbiterUnreachable, LeaseLost, WaitTimeout
from vram_arbiter.schemas.plain import Message


def test_an_evicted_lease_comes_back_under_a_new_token(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    assert (record.asleep, link.holdings.held) == ("standby", {})
    link.tick(60.0)
    assert "renew" not in [message["op"] for message in link.sent()], (
        "nothing is held, nothing is renewed or fenced"
    )
    link.push("granted", lease=view(token=[1, 9]))
    assert link.told() == [r.Returned(record)]
    assert (record.token, record.asleep, record.held, record.released) == ((1, 9), "", False, False)
    assert link.holdings.held == {record.lease_id: record}


def test_an_old_grant_said_again_is_no_return(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    link.push("granted", lease=view(token=list(record.token)))
    assert link.told() == []


def test_the_arbiter_decides_whether_a_lease_may_come_back(link: Wire) -> None:
    record = link.hold()
    evict(link, record, "standby", then="released")
    assert (record.asleep, link.holdings.asleep) == ("", {})
    parked = link.hold(nonce="n2", lease_id="L1-5", serial=6)
    evict(link, parked, "parked", then="standby")
    assert parked.asleep == "standby"


def test_who_does_not_want_to_come_back_says_so(link: Wire) -> None:
    record = link.hold()
    evict(link, record, "", then="standby")
    assert link.one("cancel")["lease_id"] == record.lease_id


def test_a_lease_on_standby_is_attached_again_and_may_have_returned_meanwhile(link: Wire) -> None:
    record = link.hold()
    evict(link, record, "parked")
    request = link.reconnect()
    assert [(item["lease_id"], item["state"]) for item in request["leases"]] == [
        (record.lease_id, "parked")
    ]
    kept = {"lease_id": record.lease_id, "kept": True, "lease": view(token=None, state="parked")}
    link.reply(request, leases=[kept])
    assert link.told() == [r.Up(1)]
    assert record.asleep == "parked"
    request = link.reconnect()
    link.reply(request, leases=[{**kept, "lease": view(token=[2, 4])}])
    assert link.told() == [r.Returned(record), r.Up(1)]


def test_a_lease_that_is_lost_while_it_waits_ends(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    request = link.reconnect()
    error = {"code": "lease_lost", "message": "gone", "hint": "", "details": {}}
    link.reply(request, leases=[{"lease_id": record.lease_id, "kept": False, "error": error}])
    gone, up = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(gone.error, LeaseLost)
    assert isinstance(up, r.Up)


def test_reacquire_is_granted_at_once_or_later_or_never(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    link.holdings.reacquire(record, 5.0, link.now)
    link.reply(link.one("reacquire"), state="loading", lease=view(token=[1, 9]))
    assert r.Returned(record) in link.told()
    evict(link, record)
    link.holdings.reacquire(record, 5.0, link.now)
    link.reply(link.one("reacquire"), state="queued", lease=view(state="queued"))
    link.told()
    link.push(
        "denied",
        lease_id=record.lease_id,
        error={"code": "wait_timeout", "message": "", "hint": "", "details": {}},
    )
    (gone,) = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(gone.error, WaitTimeout)


def test_one_requests_end_that_drops_another_does_not_stop_the_clock(link: Wire) -> None:
    """Regression: the lease ended with its `reacquire`, its `use_end` was dropped and then failed
    too, and no tick came any more."""
    record = link.hold()
    evict(link, record)
    link.holdings.reacquire(record, None, link.now)
    link.reply(link.one("reacquire"), state="queued", lease=view(state="queued"))
    link.told()
    reattach = link.reconnect()
    link.reply(
        reattach,
        leases=[{"lease_id": record.lease_id, "kept": True, "lease": view(state="queued")}],
    )
    link.one("reacquire")
    link.connection.contact_lost("test")
    link.told()
    link.holdings.use_end(record, "u1", link.now)  # a use that was yielded
    link.tick(REQUEST_TIMEOUT_S)
    (gone,) = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(gone.error, ArbiterUnreachable)
    assert link.protocol.next_deadline() is None


def left_unheard(link: Wire) -> r.LeaseRecord:
    """Evicted, and the arbiter is gone for longer than anybody waits for its answer."""
    record = link.hold()
    link.push(
        "revoke",
        lease_id=record.lease_id,
        token=list(record.token),
        reason="",
        wanted_by="",
        park=False,
    )
    link.connection.contact_lost("test")
    link.holdings.release(record, False, link.now, 5.0, asleep="standby")
    link.told()
    link.tick(5.1)
    (unheard,) = link.told()
    assert isinstance(unheard, r.Failed)
    assert isinstance(unheard.error, ArbiterUnreachable)
    return record


def back_in_contact(link: Wire, record: r.LeaseRecord, **lease: Any) -> list[Message]:
    """The arbiter is back and hears what is attached again; returns what else it is told."""
    link.connection.connected(link.now)
    link.reply(link.one("hello"), **WELCOME)
    attach = link.one("reattach")
    assert [(item["lease_id"], item["state"]) for item in attach["leases"]] == [
        (record.lease_id, "standby")
    ]
    link.reply(attach, leases=[{"lease_id": record.lease_id, "kept": True, "lease": view(**lease)}])
    return link.sent()


def test_who_wants_to_come_back_says_that_it_left_until_it_is_heard(link: Wire) -> None:
    """Regression: after 5 s without the arbiter a lease on standby was over for its holder, and
    kept its room at the arbiter."""
    record = left_unheard(link)
    link.tick(3600.0)
    assert (record.asleep, link.told()) == ("standby", [])
    (release,) = back_in_contact(link, record, token=list(record.token), state="verifying")
    assert (release["op"], release["lease_id"], release["token"]) == (
        "release", record.lease_id, list(record.token),
    )  # fmt: skip
    link.reply(release, state="verifying", next="standby")
    assert link.told() == [r.Up(1)]
    link.tick(60.0)
    assert link.said("release") == [], "it was heard"
    link.push("granted", lease=view(token=[2, 9]))
    assert link.told() == [r.Returned(record)]


def test_an_arbiter_that_will_not_have_it_back_is_believed_however_late(link: Wire) -> None:
    record = left_unheard(link)
    (release,) = back_in_contact(link, record, token=list(record.token), state="verifying")
    link.reply(release, state="verifying", next="released")
    up, gone = link.told()
    assert (up, link.holdings.asleep) == (r.Up(1), {})
    assert isinstance(gone, r.Gone)
    assert isinstance(gone.error, LeaseLost)


def test_an_answer_to_its_release_does_not_touch_a_lease_that_has_returned(link: Wire) -> None:
    """The arbiter had heard it before it died, and granted the lease again: the old token is none
    any more."""
    record = left_unheard(link)
    (release,) = back_in_contact(link, record, token=[2, 9])
    assert link.told() == [r.Returned(record), r.Up(1)]
    link.refuse(release, "stale_token")
    assert (link.told(), record.token) == ([], (2, 9))
    assert link.holdings.held == {record.lease_id: record}


def test_who_is_not_wanted_any_more_tells_of_its_leaving_no_longer(link: Wire) -> None:
    record = left_unheard(link)
    link.holdings.give_up_asleep(record, link.now)
    link.tick(REQUEST_TIMEOUT_S)
    assert link.protocol.next_deadline() is None


def test_who_left_for_good_does_not_wait_for_an_arbiter_that_is_away(link: Wire) -> None:
    """Its ttl ends it there."""
    record = link.hold()
    link.connection.contact_lost("test")
    link.holdings.release(record, False, link.now, 5.0)
    link.told()
    link.tick(5.1)
    (unheard,) = link.told()
    assert isinstance(unheard, r.Failed)
    assert link.protocol.next_deadline() is None
