"""`schemas.runtime.zmtp`: recorded bytes of real peers, every refusal, and bounds that hold for any
input."""

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.schemas.runtime.zmtp import (
    COMMAND_MAX_BYTES,
    ENVELOPE_MAX_BYTES,
    FRAMES_MAX,
    GREETING,
    READY,
    Event,
    Heartbeat,
    Message,
    Oversize,
    PeerReady,
    ServerConnection,
    WireLimits,
    ZmtpError,
    encode,
)

LIMITS = WireLimits(message_max_bytes=1000, skip_max_bytes=4000)

# what pyzmq 27.1 (libzmq 4.3.5) sent to a unix socket: greeting, READY, "hello", a heartbeat
PEER_GREETING = bytes.fromhex("ff00000000000000017f03014e554c4c") + bytes(48)
DEALER_READY = b"\x04)\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
REQ_READY = b"\x04&\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ\x08Identity\x00\x00\x00\x00"
DEALER_HELLO = b"\x00\x05hello"
REQ_HELLO = b"\x01\x00\x00\x05hello"
CORRELATED_HELLO = b"\x01\x04\xa2\x1b\x07\x00\x01\x00\x00\x05hello"  # ZMQ_REQ_CORRELATE
PING = b"\x04\x07\x04PING\x00\x00"


def events(connection: ServerConnection, data: bytes) -> list[Event]:
    connection.feed(data)
    found = []
    while (event := connection.next_event()) is not None:
        found.append(event)
    return found


def greeted(ready: bytes = DEALER_READY) -> ServerConnection:
    connection = ServerConnection(LIMITS)
    assert events(connection, PEER_GREETING + ready) == [PeerReady()]
    connection.outgoing()
    return connection


def command_frame(name: bytes, rest: bytes = b"") -> bytes:
    body = bytes((len(name),)) + name + rest
    return bytes((4, len(body))) + body


def ready(*properties: tuple[bytes, bytes]) -> bytes:
    return command_frame(
        b"READY",
        b"".join(
            bytes((len(name),)) + name + len(value).to_bytes(4) + value
            for name, value in properties
        ),
    )


@pytest.mark.parametrize(
    ("recorded", "envelope"),
    [
        (DEALER_READY + DEALER_HELLO, b""),
        (REQ_READY + REQ_HELLO, b"\x01\x00"),
        (REQ_READY + CORRELATED_HELLO, b"\x01\x04\xa2\x1b\x07\x00\x01\x00"),
    ],
    ids=["DEALER", "REQ", "REQ with a request id"],
)
@pytest.mark.parametrize("piece", [1, 7, 1000])
def test_recorded_peers_are_understood_in_pieces_of_any_size(
    recorded: bytes, envelope: bytes, piece: int
) -> None:
    data = PEER_GREETING + recorded + PING
    connection = ServerConnection(LIMITS)
    found = [
        e for at in range(0, len(data), piece) for e in events(connection, data[at : at + piece])
    ]
    assert found == [PeerReady(), Message(b"hello", envelope), Heartbeat()]
    assert connection.outgoing() == GREETING + READY + b"\x04\x05\x04PONG"
    assert connection.outgoing() == b""
    assert connection.kept_bytes == 0


def test_the_greeting_goes_out_first_and_ready_only_to_a_zmtp_peer() -> None:
    connection = ServerConnection(LIMITS)
    assert connection.outgoing() == GREETING
    assert connection.next_event() is None
    assert connection.outgoing() == b""


@pytest.mark.parametrize(
    ("data", "reason"),
    [
        (b"GET / HTTP/1.1\r\n", "not a ZMTP greeting"),
        (b"\xff\x00\x00\x00\x00\x00\x00\x00\x01\x00", "not a ZMTP greeting"),
        (PEER_GREETING[:10] + b"\x01", "ZMTP 1"),
        (PEER_GREETING[:12] + b"CURVE".ljust(20, b"\x00") + bytes(32), "security mechanism"),
        (PEER_GREETING + DEALER_HELLO, "a message before READY"),
        (PEER_GREETING + PING, "a command before READY"),
        (PEER_GREETING + command_frame(b"ERROR", b"\x00"), "refused the handshake"),
        (PEER_GREETING + ready(), "neither a DEALER nor a REQ"),
        (PEER_GREETING + ready((b"Socket-Type", b"PUB")), "neither a DEALER nor a REQ"),
        (PEER_GREETING + command_frame(b"READY", b"\x00"), "malformed property"),
        (PEER_GREETING + command_frame(b"READY", b"\x0bSocket-Type\x00\x00\xff\xffDEALER"),
         "malformed property"),
        (PEER_GREETING + command_frame(b"READY", b"\x0bSocket"), "malformed property"),
        (PEER_GREETING + b"\x04\x00", "without a name"),
        (PEER_GREETING + b"\x04\x01\x05", "without a name"),
        (PEER_GREETING + b"\x06" + (COMMAND_MAX_BYTES + 1).to_bytes(8), "a command of"),
        (PEER_GREETING + DEALER_READY + DEALER_READY, "unexpected command 'READY'"),
        (PEER_GREETING + DEALER_READY + command_frame(b"SUBSCRIBE"),
         "unexpected command 'SUBSCRIBE'"),
        (PEER_GREETING + DEALER_READY + command_frame(b"\x1b[2J"), r"'\\x1b\[2J'"),
        (PEER_GREETING + DEALER_READY + command_frame(b"PING"), "a PING of 0 bytes"),
        (PEER_GREETING + DEALER_READY + command_frame(b"PING", bytes(19)), "a PING of 19 bytes"),
        (PEER_GREETING + DEALER_READY + b"\x08\x00", "flags 0x08"),
        (PEER_GREETING + DEALER_READY + b"\x05\x00", "flags 0x05"),
        (PEER_GREETING + DEALER_READY + b"\x01\x00" * (FRAMES_MAX + 1), "more than 8 frames"),
        (PEER_GREETING + DEALER_READY + b"\x02" + b"\xff" * 8, "at most 4000 are read"),
        (PEER_GREETING + DEALER_READY + b"\x03" + (2001).to_bytes(8) + bytes(2001)
         + b"\x03" + (2000).to_bytes(8), "at most 4000"),
    ],
)  # fmt: skip
def test_what_breaks_the_protocol_is_refused(data: bytes, reason: str) -> None:
    connection = ServerConnection(LIMITS)
    with pytest.raises(ZmtpError, match=reason):
        events(connection, data)


def test_names_of_properties_are_case_insensitive_and_unknown_ones_are_allowed() -> None:
    connection = ServerConnection(LIMITS)
    data = PEER_GREETING + ready((b"X-Version", b"1"), (b"socket-type", b"DEALER"))
    assert events(connection, data) == [PeerReady()]


def test_an_identity_of_the_peer_is_read_over() -> None:
    """libzmq's ROUTER aborted on an identity that equals its next automatic routing id."""
    connection = ServerConnection(LIMITS)
    data = PEER_GREETING + ready(
        (b"Socket-Type", b"DEALER"), (b"Identity", b"\x00\x00\x00\x00\x01")
    )
    assert events(connection, data) == [PeerReady()]


@pytest.mark.parametrize("envelope", [b"", b"\x01\x00", b"\x01\x04abcd\x01\x00"])
def test_a_message_over_the_limit_is_skipped_unkept_and_the_next_one_is_read(
    envelope: bytes,
) -> None:
    connection = greeted()
    head = envelope + b"\x02" + (3000).to_bytes(8)
    assert events(connection, head) == []
    for _ in range(30):
        assert connection.kept_bytes == len(envelope)
        found = events(connection, bytes(100))
    size = 3000 + sum(envelope[1::6])  # the request id counts, too
    assert found == [Oversize(size, 1000, envelope)]
    assert events(connection, DEALER_HELLO) == [Message(b"hello", b"")]
    assert connection.kept_bytes == 0


def test_the_limit_counts_all_frames_of_a_message() -> None:
    """libzmq's ZMQ_MAXMSGSIZE is per frame: frames with MORE grew the daemon to 1,454 MiB."""
    connection = greeted()
    frame = b"\x03" + (600).to_bytes(8) + bytes(600)
    assert events(connection, frame + frame) == []
    assert connection.kept_bytes == 0
    assert events(connection, b"\x00\x00") == [Oversize(1200, 1000, b"")]


@pytest.mark.parametrize(
    ("frames", "found"),
    [
        (b"\x01\x01a\x00\x01b", (b"", b"")),  # no empty frame
        (b"\x01\x00\x01\x00\x00\x01b", (b"", b"\x01\x00")),  # two payloads
        (b"\x01\x01a\x01\x00\x01\x01b\x00\x01c", (b"", b"\x01\x01a\x01\x00")),
        (b"\x01\xff" + bytes(255) + b"\x01\xff" + bytes(255) + REQ_HELLO, (b"", b"")),  # too long
        (b"\x03" + (256).to_bytes(8) + bytes(256) + REQ_HELLO, (b"", b"")),
        (b"\x01\x05proxy" + CORRELATED_HELLO, (b"hello", b"\x01\x05proxy" + CORRELATED_HELLO[:8])),
    ],
)
def test_what_stands_before_the_payload_is_an_envelope_or_nothing_is_taken(
    frames: bytes, found: tuple[bytes, bytes]
) -> None:
    """Another form arrives as an empty payload: the server answers it with a typed error instead of
    guessing which frame was meant."""
    connection = greeted()
    assert events(connection, frames) == [Message(*found)]
    assert events(connection, REQ_HELLO) == [Message(b"hello", b"\x01\x00")]


def test_a_ping_is_answered_with_its_context_and_a_pong_is_not() -> None:
    connection = greeted()
    assert events(
        connection, command_frame(b"PING", b"\x00\x64context") + command_frame(b"PONG")
    ) == [Heartbeat(), Heartbeat()]
    assert connection.outgoing() == b"\x04\x0c\x04PONGcontext"


@given(
    payloads=st.lists(st.binary(max_size=700), max_size=6),
    request_ids=st.none() | st.lists(st.binary(min_size=1, max_size=80), max_size=5),
    pieces=st.lists(st.integers(1, 400), max_size=20),
)
def test_what_is_encoded_is_read_again(
    payloads: list[bytes], request_ids: list[bytes] | None, pieces: list[int]
) -> None:
    envelope = b""
    for frame in () if request_ids is None else (*request_ids, b""):
        envelope += bytes((1, len(frame))) + frame
    data = b"".join(encode(payload, envelope) for payload in payloads)
    connection, found, at = greeted(), [], 0
    for piece in [*pieces, len(data)]:
        found += events(connection, data[at : at + piece])
        at += piece
    assert found == [Message(payload, envelope) for payload in payloads]


@given(
    data=st.lists(
        st.one_of(
            st.binary(max_size=80),
            st.sampled_from(
                [PEER_GREETING, DEALER_READY, REQ_READY, DEALER_HELLO, REQ_HELLO, CORRELATED_HELLO]
            ),
            st.builds(lambda size: b"\x02" + size.to_bytes(8), st.integers(0, 5000)),
            st.builds(bytes, st.integers(0, 3000)),
        ),
        max_size=12,
    )
)
def test_any_bytes_give_events_or_one_error_and_little_is_kept(data: list[bytes]) -> None:
    connection = ServerConnection(LIMITS)
    events(connection, PEER_GREETING)
    try:
        for piece in data:
            for event in events(connection, piece):
                if isinstance(event, Message):
                    assert len(event.payload) <= LIMITS.message_max_bytes
            kept_max = LIMITS.message_max_bytes + COMMAND_MAX_BYTES + ENVELOPE_MAX_BYTES
            assert connection.kept_bytes <= kept_max
            assert len(connection.outgoing()) <= len(GREETING) + len(READY) + 2 * len(piece)
    except ZmtpError:
        pass
