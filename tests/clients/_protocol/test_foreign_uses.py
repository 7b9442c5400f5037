"""Uses of the client's protocol on leases of other processes."""

from tests.support.protocol_wire import Wire
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.clients._protocol.connection import REQUEST_TIMEOUT_S
from vram_arbiter.schemas.ids import LeaseId, Token, UseId
from vram_arbiter.schemas.wire.requests import UseBegin, UseEnd

ON = (LeaseId("L9-1"), Token(9, 2), UseId("u1"))
BEGIN, END = UseBegin(*ON, "goal"), UseEnd(*ON)


def test_a_use_on_anothers_lease_is_begun_again_until_it_ends(link: Wire) -> None:
    link.foreign_uses.begin(BEGIN, link.now, REQUEST_TIMEOUT_S)
    link.reply(link.one("use_begin"))
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    again = link.one("use_begin")
    assert (again["use_id"], again["token"]) == ("u1", [9, 2])
    link.reply(again)
    link.foreign_uses.end(END, link.now)
    link.reply(link.one("use_end"))
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


def test_a_use_that_cannot_be_begun_again_is_lost(link: Wire) -> None:
    link.foreign_uses.begin(BEGIN, link.now, REQUEST_TIMEOUT_S)
    link.reply(link.one("use_begin"))
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    link.refuse(link.one("use_begin"), "lease_lost")
    (lost,) = link.told()
    assert isinstance(lost, r.UseLost)
    assert lost.use_id == "u1"


def test_a_use_ended_before_its_begin_was_answered_stays_ended(link: Wire) -> None:
    link.foreign_uses.begin(BEGIN, link.now, REQUEST_TIMEOUT_S)
    begin = link.one("use_begin")
    link.foreign_uses.end(END, link.now)
    link.reply(link.one("use_end"))
    link.reply(begin)
    link.connection.contact_lost("test")
    link.told()
    link.greet()
    assert link.sent() == []


def test_the_arbiter_hears_of_a_client_in_a_use_also_while_it_pushes(link: Wire) -> None:
    """A guest that is silent loses its uses, and a subscriber of a busy arbiter pinged no more."""
    link.foreign_uses.begin(BEGIN, link.now, REQUEST_TIMEOUT_S)
    link.reply(link.one("use_begin"))
    link.tick(1.5)
    link.push("event", event={"seq": 1, "kind": "granted"})
    link.tick(0.5)
    link.reply(link.one("ping"))
    link.foreign_uses.end(END, link.now)
    link.reply(link.one("use_end"))
    link.tick(1.5)
    link.push("event", event={"seq": 2, "kind": "granted"})
    link.tick(0.5)
    assert link.sent() == [], "without a use pushes are enough"
