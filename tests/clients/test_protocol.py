"""The client's protocol without sockets and without time passing by itself."""

from collections.abc import Mapping
from typing import Any

import pytest

from clients import records as r
from clients.protocol import (
    HELLO_TIMEOUT_S,
    REQUEST_TIMEOUT_S,
    SILENCE_BEATS,
    WAIT_SLACK_S,
    ClientProtocol,
)
from schemas import wire
from schemas.errors import (
    ArbiterUnreachable,
    BadState,
    LeaseExpired,
    LeaseLost,
    StaleToken,
    VersionMismatch,
    VramInsufficient,
    WaitTimeout,
)

SPEC = wire.LeaseSpec(
    consumer="detector",
    model_id="m",
    ttl_s=9.0,
    footprint=wire.Footprint(load_peak_bytes=5, steady_bytes=4, residue_bytes=1),
).model_dump(mode="json")
WELCOME = {"version": 1, "boot_id": "b", "server": "s", "role": "client", "heartbeat_s": 2.0, "grace_s": 5.0}


def view(lease_id: str = "L1-1", token: list[int] | None = None, state: str = "loading") -> dict[str, Any]:
    return {"lease_id": lease_id, "token": token, "state": state, "gpu": "GPU-1"}


class Wire:
    """Both ends: the protocol and an arbiter that says what the test tells it to. Every request must be valid on the wire."""

    def __init__(self) -> None:
        self.protocol = ClientProtocol(name="test", instance="1-a")
        self.epoch = 1
        self.now = 100.0

    def sent(self) -> list[dict[str, Any]]:
        messages = self.protocol.take_outgoing()
        for message in messages:
            wire.REQUEST.validate_python(message)
        return messages

    def told(self) -> list[r.Event]:
        return self.protocol.take_events()

    def one(self, op: str) -> dict[str, Any]:
        (message,) = self.sent()
        assert message["op"] == op
        return message

    def reply(self, request: Mapping[str, Any], **body: Any) -> None:
        self.protocol.receive({"re": request["id"], "epoch": self.epoch, "ok": True, **body}, self.now)

    def refuse(self, request: Mapping[str, Any], code: str, **details: Any) -> None:
        error = {"code": code, "message": "no", "hint": "", "details": details}
        self.protocol.receive(
            {"re": request["id"], "epoch": self.epoch, "ok": False, "error": error}, self.now
        )

    def push(self, kind: str, **body: Any) -> None:
        self.protocol.receive({"push": kind, "seq": 1, "epoch": self.epoch, **body}, self.now)

    def tick(self, seconds: float) -> None:
        self.now += seconds
        self.protocol.tick(self.now)

    def greet(self) -> None:
        """Hello until up, without leases to re-attach."""
        self.protocol.connected(self.now)
        hello = self.one("hello")
        self.reply(hello, **WELCOME)
        assert r.Up(self.epoch) in self.told()

    def grant(self, nonce: str = "n1", lease_id: str = "L1-1", serial: int = 2) -> r.LeaseRecord:
        self.protocol.acquire(nonce, SPEC, self.now)
        self.reply(self.one("acquire"), state="loading", lease=view(lease_id, [1, serial]))
        (granted,) = self.told()
        assert isinstance(granted, r.Granted)
        return granted.record

    def hold(self, **names: Any) -> r.LeaseRecord:
        record = self.grant(**names)
        self.protocol.ready(record, 4, self.now)
        self.reply(self.one("ready"))
        self.told()
        return record

    def reconnect(self) -> dict[str, Any]:
        """Lose contact, say hello again; returns the reattach request."""
        self.protocol.contact_lost("test")
        assert self.told() == [r.ContactLost("test")]
        self.protocol.connected(self.now)
        self.reply(self.one("hello"), **WELCOME)
        return self.one("reattach")


@pytest.fixture
def link() -> Wire:
    made = Wire()
    made.greet()
    return made


# -- greeting --------------------------------------------------------------------------------------------------------
def test_requests_before_the_greeting_are_sent_after_it() -> None:
    link = Wire()
    request = link.protocol.request("status", {}, link.now)
    assert link.sent() == []
    link.greet()
    message = link.one("status")
    link.reply(message, phase="serving")
    (replied,) = link.told()
    assert isinstance(replied, r.Replied)
    assert (replied.request_id, replied.body["phase"]) == (request, "serving")


def test_hello_without_an_answer_asks_for_a_fresh_socket() -> None:
    link = Wire()
    link.protocol.connected(link.now)
    assert link.protocol.next_deadline() == link.now + HELLO_TIMEOUT_S
    link.tick(HELLO_TIMEOUT_S)
    assert link.told() == [r.ContactLost("no answer to hello")]
    assert link.protocol.phase == "down"


def test_a_refused_hello_is_told_and_tried_again() -> None:
    link = Wire()
    link.protocol.connected(link.now)
    link.refuse(link.one("hello"), "version_mismatch")
    (refused,) = link.told()
    assert isinstance(refused, r.Refused)
    assert isinstance(refused.error, VersionMismatch)
    link.tick(HELLO_TIMEOUT_S)
    assert isinstance(link.told()[0], r.ContactLost)


def test_values_of_the_welcome_are_used(link: Wire) -> None:
    link.protocol.connected(link.now)
    link.reply(link.one("hello"), **WELCOME | {"heartbeat_s": 7.0, "grace_s": 1.5})
    assert (link.protocol.heartbeat_s, link.protocol.grace_s) == (7.0, 1.5)


def test_words_from_a_lost_connection_are_ignored(link: Wire) -> None:
    link.protocol.contact_lost("test")
    link.told()
    link.push("granted", lease=view("L1-9", [1, 9]))
    assert link.told() == []
    link.protocol.contact_lost("again")
    assert link.told() == []


# -- requests --------------------------------------------------------------------------------------------------------
def test_an_error_reply_is_the_typed_error(link: Wire) -> None:
    request = link.protocol.request("why", {"consumer": "x"}, link.now)
    link.refuse(link.one("why"), "limit_exceeded", limit="rate")
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert (failed.request_id, failed.error.code, failed.error.details["limit"]) == (
        request,
        "limit_exceeded",
        "rate",
    )


def test_an_unanswered_request_ends_at_its_deadline(link: Wire) -> None:
    request = link.protocol.request("status", {}, link.now, timeout_s=1.5)
    link.sent()
    link.tick(1.4)
    assert link.told() == []
    link.tick(0.1)
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert failed.request_id == request
    assert isinstance(failed.error, ArbiterUnreachable)


def test_replies_nobody_asked_for_and_unknown_pushes_are_ignored(link: Wire) -> None:
    for message in ({"re": 999, "ok": True}, {"re": None, "ok": False, "error": {}}, {"push": "news"}):
        link.protocol.receive({"epoch": 1, **message}, link.now)
    assert link.told() == []


def test_a_forgotten_request_tells_nobody(link: Wire) -> None:
    request = link.protocol.request("status", {}, link.now)
    link.protocol.forget(request)
    link.reply(link.one("status"))
    assert link.told() == []


def test_requests_under_way_are_said_again_after_a_reconnect(link: Wire) -> None:
    link.protocol.request("status", {}, link.now)
    first = link.one("status")
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    assert link.one("status") == first


def test_a_session_that_the_arbiter_forgot_is_made_anew(link: Wire) -> None:
    link.protocol.request("status", {}, link.now)
    link.refuse(link.one("status"), "unknown_session")
    (lost,) = link.told()
    assert isinstance(lost, r.ContactLost)
    link.greet()
    link.reply(link.one("status"))
    assert isinstance(link.told()[0], r.Replied)


# -- heartbeat ---------------------------------------------------------------------------------------------------------
def test_silence_is_asked_about_and_then_means_lost_contact(link: Wire) -> None:
    assert link.protocol.next_deadline() == link.now + 2.0
    link.tick(2.0)
    ping = link.one("ping")
    link.reply(ping)
    assert link.told() == []
    link.tick(2.0)
    link.one("ping")
    link.tick(2.0 * (SILENCE_BEATS - 1))
    (lost,) = link.told()
    assert isinstance(lost, r.ContactLost)


# -- acquire -------------------------------------------------------------------------------------------------------------
def test_granted_at_once(link: Wire) -> None:
    record = link.grant()
    assert (record.lease_id, record.token, record.held) == ("L1-1", (1, 2), False)
    assert list(link.protocol.leases) == ["L1-1"]


def test_queued_then_granted_by_push(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now, wait_timeout_s=60.0)
    message = link.one("acquire")
    assert (message["nonce"], message["wait_timeout_s"]) == ("n1", 60.0)
    link.reply(message, state="queued", lease=view())
    assert link.told() == []
    link.push("granted", lease=view(token=[1, 2]))
    (granted,) = link.told()
    assert isinstance(granted, r.Granted)


def test_refused_at_once(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.refuse(link.one("acquire"), "vram_insufficient", needed_bytes=5)
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, VramInsufficient)


def test_denied_while_queued(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.push("denied", lease_id="L1-1", error={"code": "wait_timeout", "message": "x"})
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, WaitTimeout)
    link.push("granted", lease=view(token=[1, 2]))
    assert link.told() == []


def test_a_queued_acquire_is_said_again_after_a_reconnect_with_the_time_left(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now, wait_timeout_s=60.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.protocol.contact_lost("test")
    link.told()
    link.now += 20.0
    link.epoch = 2
    link.greet()
    again = link.one("acquire")
    assert (again["nonce"], again["wait_timeout_s"]) == ("n1", 40.0)
    link.reply(again, state="queued", lease=view("L2-1"))
    link.push("granted", lease=view("L2-1", [2, 2]))
    (granted,) = link.told()
    assert isinstance(granted, r.Granted)
    assert granted.record.lease_id == "L2-1"


def test_a_wait_that_the_arbiter_does_not_end_is_ended_here(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now, wait_timeout_s=3.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.protocol.contact_lost("test")
    link.told()
    link.tick(3.0)
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, WaitTimeout)
    link.greet()
    assert {message["op"] for message in link.sent()} == {"acquire", "cancel"}


def test_while_in_contact_the_arbiter_has_the_first_word_on_a_wait(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now, wait_timeout_s=3.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.tick(3.0)
    assert link.told() == []
    link.tick(WAIT_SLACK_S)
    assert isinstance(link.told()[0], r.Denied)


def test_cancelled_while_queued(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.protocol.cancel_acquire("n1", link.now)
    cancel = link.one("cancel")
    assert cancel["lease_id"] == "L1-1"
    link.reply(cancel)
    assert link.told() == []
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


def test_cancelled_before_the_answer(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    acquire = link.one("acquire")
    link.protocol.cancel_acquire("n1", link.now)
    assert link.sent() == []
    link.reply(acquire, state="queued", lease=view())
    link.one("cancel")
    assert link.told() == []


def test_a_grant_that_crosses_the_cancel_is_handed_back(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.protocol.cancel_acquire("n1", link.now)
    cancel = link.one("cancel")
    link.push("granted", lease=view(token=[1, 2]))
    release = link.one("release")
    assert (release["lease_id"], release["token"]) == ("L1-1", [1, 2])
    link.refuse(cancel, "bad_state")
    assert link.told() == []
    assert link.protocol.leases == {}


def test_a_cancelled_acquire_that_was_never_answered_is_cleared_up_after_a_reconnect(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.sent()
    link.protocol.cancel_acquire("n1", link.now)
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    again = link.one("acquire")
    link.reply(again, state="loading", lease=view(token=[1, 2]))
    link.one("release")
    assert link.told() == []


# -- holding ---------------------------------------------------------------------------------------------------------------
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
    assert (
        record.confirmed_at == asked_at
    )  # the arbiter counts from the message it heard, not from our hearing of it


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
    assert link.protocol.leases == {}


def test_a_grant_that_was_read_too_late_is_fenced_at_once(link: Wire) -> None:
    """Regression: a process that was stopped while its grant lay in its socket took it for new, and loaded what had been given to
    others meanwhile (`lost` had been lost with the connection)."""
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.now += 20.0  # stopped; the arbiter granted, waited for a renewal, and gave the room away
    link.push("granted", lease=view(token=[1, 2]))
    link.tick(0.0)
    granted, gone = link.told()
    assert isinstance(granted, r.Granted)
    assert isinstance(gone, r.Gone)
    assert gone.fenced


def test_a_queued_lease_that_was_away_is_no_grant(link: Wire) -> None:
    """Regression: it shows its last token while it waits, and was taken for granted."""
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view(token=[1, 2], state="queued"))
    assert link.told() == []
    link.push("granted", lease=view(token=[1, 3]))
    (granted,) = link.told()
    assert isinstance(granted, r.Granted)
    assert granted.record.token == (1, 3)


def test_a_waiter_asks_often_enough_to_know_the_age_of_its_grant(link: Wire) -> None:
    link.protocol.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    for _ in range(5):  # pushes keep coming, so silence alone would never make it ask
        link.tick(1.9)
        for message in link.sent():
            assert message["op"] == "ping"
            link.reply(message)
        link.push("event", event={})
    link.push("granted", lease=view(token=[1, 2]))
    (granted,) = [event for event in link.told() if isinstance(event, r.Granted)]
    assert link.now - granted.record.confirmed_at < 4.0


def test_fenced_after_ttl_and_grace_without_a_word(link: Wire) -> None:
    record = link.hold()
    link.protocol.contact_lost("test")
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
    link.protocol.unloading(record, link.now)
    link.refuse(link.one("unloading"), "stale_token")
    gone, failed = link.told()
    assert isinstance(gone, r.Gone)
    assert isinstance(failed, r.Failed)
    assert isinstance(failed.error, StaleToken)


def test_a_refused_use_does_not_count(link: Wire) -> None:
    record = link.hold()
    link.protocol.use_begin(record, "u1", "goal", link.now)
    assert record.uses == {"u1"}
    link.refuse(link.one("use_begin"), "lease_revoking")
    assert record.uses == set()
    assert link.protocol.leases


def test_revoke_is_told_first_once_and_then_as_news(link: Wire) -> None:
    record = link.hold()
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=1)
    link.push("revoke", lease_id="L1-1", token=[1, 2], uses=0)
    first, second = link.told()
    assert isinstance(first, r.RevokeAsked)
    assert isinstance(second, r.RevokeAsked)
    assert (first.first, second.first, record.server_uses) == (True, False, 0)
    link.push("revoke", lease_id="L1-1", token=[1, 7], uses=0)
    assert link.told() == []


def test_a_released_lease_is_neither_renewed_nor_reattached(link: Wire) -> None:
    record = link.hold()
    link.protocol.release(record, False, link.now, 5.0)
    link.one("release")
    link.tick(3.0)
    assert all(message["op"] == "ping" for message in link.sent())


# -- reconnect -----------------------------------------------------------------------------------------------------------
def test_reattachment_says_what_is_held_and_used(link: Wire) -> None:
    record = link.hold()
    link.protocol.use_begin(record, "u1", "x", link.now)
    link.reply(link.one("use_begin"))
    link.told()
    loading = link.grant("n2", "L1-3", 4)
    link.told()
    reattach = link.reconnect()
    shown = [(e["lease_id"], e["state"], e["measured_bytes"], e["use_ids"]) for e in reattach["leases"]]
    assert shown == [("L1-1", "held", 4, ["u1"]), ("L1-3", "loading", None, [])]
    assert link.protocol.phase == "reattaching"
    link.epoch = 2
    link.reply(
        reattach,
        leases=[
            {"lease_id": "L1-1", "kept": True, "lease": {}},
            {"lease_id": "L1-3", "kept": False, "error": {"code": "lease_expired"}},
        ],
    )
    gone, up = link.told()
    assert isinstance(gone, r.Gone)
    assert gone.record is loading
    assert isinstance(up, r.Up)
    assert list(link.protocol.leases) == ["L1-1"]


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
    link.protocol.ready(record, 4, link.now)
    link.one("ready")
    reattach = link.reconnect()
    assert reattach["leases"][0]["state"] == "loading"
    link.reply(reattach, leases=[{"lease_id": "L1-1", "kept": True}])
    link.reply(link.one("ready"))
    assert record.held


# -- uses on the leases of others ------------------------------------------------------------------------------------------
def test_a_use_on_anothers_lease_is_begun_again_until_it_ends(link: Wire) -> None:
    link.protocol.foreign_use_begin("L9-1", (9, 2), "u1", "goal", link.now, REQUEST_TIMEOUT_S)
    link.reply(link.one("use_begin"))
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    again = link.one("use_begin")
    assert (again["use_id"], again["token"]) == ("u1", [9, 2])
    link.reply(again)
    link.protocol.foreign_use_end("L9-1", (9, 2), "u1", link.now)
    link.reply(link.one("use_end"))
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


def test_a_use_that_cannot_be_begun_again_is_lost(link: Wire) -> None:
    link.protocol.foreign_use_begin("L9-1", (9, 2), "u1", "goal", link.now, REQUEST_TIMEOUT_S)
    link.reply(link.one("use_begin"))
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    link.refuse(link.one("use_begin"), "lease_lost")
    (lost,) = link.told()
    assert isinstance(lost, r.UseLost)
    assert lost.use_id == "u1"


def test_a_use_ended_before_its_begin_was_answered_stays_ended(link: Wire) -> None:
    link.protocol.foreign_use_begin("L9-1", (9, 2), "u1", "goal", link.now, REQUEST_TIMEOUT_S)
    begin = link.one("use_begin")
    link.protocol.foreign_use_end("L9-1", (9, 2), "u1", link.now)
    link.reply(link.one("use_end"))
    link.reply(begin)
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


# -- history ---------------------------------------------------------------------------------------------------------------
def test_a_subscription_outlives_the_connection(link: Wire) -> None:
    link.protocol.subscribe(link.now)
    link.reply(link.one("subscribe"))
    link.told()
    link.push("event", event={"seq": 1, "kind": "granted"})
    assert link.told() == [r.HistoryEvent({"seq": 1, "kind": "granted"})]
    link.protocol.contact_lost("test")
    link.told()
    link.greet()
    link.one("subscribe")


def test_bad_state_is_no_loss(link: Wire) -> None:
    record = link.hold()
    link.protocol.unloading(record, link.now)
    link.refuse(link.one("unloading"), "bad_state", uses=1)
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert isinstance(failed.error, BadState)
    assert link.protocol.leases


# -- leases that leave and come back -------------------------------------------------------------------------------------
def evict(link: Wire, record: r.LeaseRecord, asleep: str = "standby", then: str | None = None) -> None:
    """The holder is asked, lets go, and hears how the lease waits."""
    link.push(
        "revoke", lease_id=record.lease_id, token=list(record.token), reason="", wanted_by="", park=True
    )
    link.protocol.release(record, False, link.now, 5.0, asleep=asleep)
    message = link.one("release")
    assert message["parked"] == (asleep == "parked")
    link.reply(message, state="verifying", next=asleep if then is None else then)
    link.told()


def test_an_evicted_lease_comes_back_under_a_new_token(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    assert (record.asleep, link.protocol.leases) == ("standby", {})
    link.tick(60.0)
    assert "renew" not in [message["op"] for message in link.sent()], (
        "nothing is held, nothing is renewed or fenced"
    )
    link.push("granted", lease=view(token=[1, 9]))
    assert link.told() == [r.Returned(record)]
    assert (record.token, record.asleep, record.held, record.released) == ((1, 9), "", False, False)
    assert link.protocol.leases == {record.lease_id: record}


def test_an_old_grant_said_again_is_no_return(link: Wire) -> None:
    record = link.hold()
    evict(link, record)
    link.push("granted", lease=view(token=list(record.token)))
    assert link.told() == []


def test_the_arbiter_decides_whether_a_lease_may_come_back(link: Wire) -> None:
    record = link.hold()
    evict(link, record, "standby", then="released")
    assert (record.asleep, link.protocol.asleep) == ("", {})
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
    assert [(item["lease_id"], item["state"]) for item in request["leases"]] == [(record.lease_id, "parked")]
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
    link.protocol.reacquire(record, 5.0, link.now)
    link.reply(link.one("reacquire"), state="loading", lease=view(token=[1, 9]))
    assert r.Returned(record) in link.told()
    evict(link, record)
    link.protocol.reacquire(record, 5.0, link.now)
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


def test_a_resize_ends_by_reply_push_or_denial(link: Wire) -> None:
    record = link.hold()
    footprint = {"load_peak_bytes": 9, "steady_bytes": 9, "residue_bytes": 1}
    link.protocol.resize(record, footprint, None, link.now)
    link.reply(link.one("resize"), state="growing", lease=view())
    assert record.spec["footprint"] == footprint
    link.told()
    link.push("resized", lease_id=record.lease_id, token=list(record.token), charge_bytes=9)
    assert link.told() == [r.Resized(record)]
    link.push(
        "denied",
        lease_id=record.lease_id,
        error={"code": "wait_timeout", "message": "", "hint": "", "details": {}},
    )
    (resized,) = link.told()
    assert isinstance(resized, r.Resized)
    assert isinstance(resized.error, WaitTimeout)


def test_a_yielded_use_is_not_attached_again(link: Wire) -> None:
    record = link.hold()
    link.protocol.use_begin(record, "u1", "", link.now)
    link.reply(link.one("use_begin"), uses=1)
    link.protocol.use_yield(record, "u1", link.now)
    link.reply(link.one("yield"), uses=0)
    link.told()
    assert link.reconnect()["leases"][0]["use_ids"] == []
