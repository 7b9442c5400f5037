"""Acquires of the client's protocol from the question to the grant, the refusal or the cancel."""

from tests.support.protocol_wire import SPEC, Wire, view
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import WAIT_SLACK_S
from vram_arbiter.schemas.errors import VramInsufficient, WaitTimeout


def test_granted_at_once(link: Wire) -> None:
    record = link.grant()
    assert (record.lease_id, record.token, record.held) == ("L1-1", (1, 2), False)
    assert list(link.holdings.held) == ["L1-1"]


def test_queued_then_granted_by_push(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now, wait_timeout_s=60.0)
    message = link.one("acquire")
    assert (message["nonce"], message["wait_timeout_s"]) == ("n1", 60.0)
    link.reply(message, state="queued", lease=view())
    assert link.told() == []
    link.push("granted", lease=view(token=[1, 2]))
    (granted,) = link.told()
    assert isinstance(granted, r.Granted)


def test_refused_at_once(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    link.refuse(link.one("acquire"), "vram_insufficient", needed_bytes=5)
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, VramInsufficient)


def test_denied_while_queued(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.push("denied", lease_id="L1-1", error={"code": "wait_timeout", "message": "x"})
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, WaitTimeout)
    link.push("granted", lease=view(token=[1, 2]))
    assert link.told() == []


def test_a_queued_acquire_is_said_again_after_a_reconnect_with_the_time_left(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now, wait_timeout_s=60.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.connection.contact_lost("test")
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
    link.waits.acquire("n1", SPEC, link.now, wait_timeout_s=3.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.connection.contact_lost("test")
    link.told()
    link.tick(3.0)
    (denied,) = link.told()
    assert isinstance(denied, r.Denied)
    assert isinstance(denied.error, WaitTimeout)
    link.greet()
    assert {message["op"] for message in link.sent()} == {"acquire", "cancel"}


def test_while_in_contact_the_arbiter_has_the_first_word_on_a_wait(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now, wait_timeout_s=3.0)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.tick(3.0)
    assert link.told() == []
    link.tick(WAIT_SLACK_S)
    assert isinstance(link.told()[0], r.Denied)


def test_cancelled_while_queued(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.waits.cancel("n1", link.now)
    cancel = link.one("cancel")
    assert cancel["lease_id"] == "L1-1"
    link.reply(cancel)
    assert link.told() == []
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


def test_cancelled_before_the_answer(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    acquire = link.one("acquire")
    link.waits.cancel("n1", link.now)
    assert link.sent() == []
    link.reply(acquire, state="queued", lease=view())
    link.one("cancel")
    assert link.told() == []


def test_a_grant_that_crosses_the_cancel_is_handed_back(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view())
    link.waits.cancel("n1", link.now)
    cancel = link.one("cancel")
    link.push("granted", lease=view(token=[1, 2]))
    release = link.one("release")
    assert (release["lease_id"], release["token"]) == ("L1-1", [1, 2])
    link.refuse(cancel, "bad_state")
    assert link.told() == []
    assert link.holdings.held == {}


def test_a_cancelled_acquire_that_was_never_answered_is_cleared_up_after_a_reconnect(
    link: Wire,
) -> None:
    link.waits.acquire("n1", SPEC, link.now)
    link.sent()
    link.waits.cancel("n1", link.now)
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    again = link.one("acquire")
    link.reply(again, state="loading", lease=view(token=[1, 2]))
    link.one("release")
    assert link.told() == []


def test_a_grant_that_was_read_too_late_is_fenced_at_once(link: Wire) -> None:
    """Regression: a process that was stopped while its grant lay in its socket took it for new, and
    loaded what had been given to others meanwhile (`lost` had been lost with the connection)."""
    link.waits.acquire("n1", SPEC, link.now)
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
    link.waits.acquire("n1", SPEC, link.now)
    link.reply(link.one("acquire"), state="queued", lease=view(token=[1, 2], state="queued"))
    assert link.told() == []
    link.push("granted", lease=view(token=[1, 3]))
    (granted,) = link.told()
    assert isinstance(granted, r.Granted)
    assert granted.record.token == (1, 3)


def test_a_waiter_asks_often_enough_to_know_the_age_of_its_grant(link: Wire) -> None:
    link.waits.acquire("n1", SPEC, link.now)
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
