"""The client's connection without sockets and without time passing by itself: greeting, requests,
silence, history."""

from tests.support.protocol_wire import WELCOME, Wire, view
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import HELLO_TIMEOUT_S, SILENCE_BEATS
from vram_arbiter.schemas.errors import ArbiterUnreachable, VersionMismatch
from vram_arbiter.schemas.wire.requests import AskWhy, ConsumerDemand, Demand, Status


# -- greeting
def test_requests_before_the_greeting_are_sent_after_it() -> None:
    link = Wire()
    request = link.connection.ask(Status(), link.now)
    assert link.sent() == []
    link.greet()
    message = link.one("status")
    link.reply(message, phase="serving")
    (replied,) = link.told()
    assert isinstance(replied, r.Replied)
    assert (replied.request_id, replied.body.phase) == (request, "serving")


def test_hello_without_an_answer_asks_for_a_fresh_socket() -> None:
    link = Wire()
    link.connection.connected(link.now)
    assert link.protocol.next_deadline() == link.now + HELLO_TIMEOUT_S
    link.tick(HELLO_TIMEOUT_S)
    assert link.told() == [r.ContactLost("no answer to hello")]
    assert link.connection.phase == "down"


def test_a_refused_hello_is_told_and_tried_again() -> None:
    link = Wire()
    link.connection.connected(link.now)
    link.refuse(link.one("hello"), "version_mismatch")
    (refused,) = link.told()
    assert isinstance(refused, r.GreetingRefused)
    assert isinstance(refused.error, VersionMismatch)
    link.tick(HELLO_TIMEOUT_S)
    assert isinstance(link.told()[0], r.ContactLost)


def test_values_of_the_welcome_are_used(link: Wire) -> None:
    link.connection.connected(link.now)
    link.reply(link.one("hello"), **WELCOME | {"heartbeat_s": 7.0, "grace_s": 1.5})
    assert (link.connection.heartbeat_s, link.connection.grace_s) == (7.0, 1.5)


def test_words_from_a_lost_connection_are_ignored(link: Wire) -> None:
    link.connection.contact_lost("test")
    link.told()
    link.push("granted", lease=view("L1-9", [1, 9]))
    assert link.told() == []
    link.connection.contact_lost("again")
    assert link.told() == []


# -- requests
def test_an_error_reply_is_the_typed_error(link: Wire) -> None:
    request = link.connection.ask(AskWhy("x"), link.now)
    link.refuse(link.one("why"), "limit_exceeded", limit="rate")
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert (failed.request_id, failed.error.code, failed.error.details["limit"]) == (
        request,
        "limit_exceeded",
        "rate",
    )


def test_an_unanswered_request_ends_at_its_deadline(link: Wire) -> None:
    request = link.connection.ask(Status(), link.now, timeout_s=1.5)
    link.sent()
    link.tick(1.4)
    assert link.told() == []
    link.tick(0.1)
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert failed.request_id == request
    assert isinstance(failed.error, ArbiterUnreachable)


def test_replies_nobody_asked_for_and_unknown_pushes_are_ignored(link: Wire) -> None:
    for message in (
        {"re": 999, "ok": True},
        {"re": None, "ok": False, "error": {}},
        {"push": "news"},
    ):
        link.connection.receive({"epoch": 1, **message}, link.now)
    assert link.told() == []


def test_a_forgotten_request_tells_nobody(link: Wire) -> None:
    request = link.connection.ask(Status(), link.now)
    link.connection.forget(request)
    link.reply(link.one("status"))
    assert link.told() == []


def test_requests_under_way_are_said_again_after_a_reconnect(link: Wire) -> None:
    link.connection.ask(Status(), link.now)
    first = link.one("status")
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    assert link.one("status") == first


def test_a_session_that_the_arbiter_forgot_is_made_anew(link: Wire) -> None:
    link.connection.ask(Status(), link.now)
    link.refuse(link.one("status"), "unknown_session")
    (lost,) = link.told()
    assert isinstance(lost, r.ContactLost)
    link.greet()
    link.reply(link.one("status"))
    assert isinstance(link.told()[0], r.Replied)


# -- heartbeat
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


# -- history
def test_a_subscription_outlives_the_connection(link: Wire) -> None:
    link.protocol.subscribe(link.now)
    link.reply(link.one("subscribe"))
    link.told()
    link.push("event", event={"seq": 1, "kind": "granted"})
    assert link.told() == [r.HistoryEvent({"seq": 1, "kind": "granted"})]
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    link.one("subscribe")


def test_what_was_told_of_requests_is_told_again_after_a_reconnect(link: Wire) -> None:
    for waiting in (1, 2):
        link.protocol.demand(Demand((ConsumerDemand("llm", 3, waiting),)), link.now)
        link.reply(link.one("demand"))
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    assert link.one("demand")["consumers"] == [{"consumer": "llm", "in_flight": 3, "waiting": 2}]


def test_an_answer_of_another_shape_fails_its_request(link: Wire) -> None:
    """A reply without its fields ended in a KeyError somewhere in the client."""
    request = link.connection.ask(Status(), link.now)
    link.reply(link.one("status"), leases=[{"lease_id": "L1-1"}])
    (failed,) = link.told()
    assert isinstance(failed, r.Failed)
    assert failed.request_id == request
    assert "the arbiter's answer to status is not understood" in str(failed.error)


def test_a_push_of_a_newer_arbiter_is_ignored(link: Wire) -> None:
    link.push("sung", lease_id="L1-1")
    assert link.told() == []
