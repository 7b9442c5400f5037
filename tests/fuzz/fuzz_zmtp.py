"""Coverage-guided fuzzing of the ZMTP framing with atheris: `python tests/fuzz/fuzz_zmtp.py
-runs=10000000 [CORPUS]`.

atheris is not a dependency of this project: `pip install atheris` into an environment of its own.
The first byte of an input says into how many pieces the rest is cut. Ends with libFuzzer's report;
a finding is an input that raises anything but `ZmtpError`, keeps more bytes than the limits allow,
or reads differently in pieces than in one.
"""

import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(include=["vram_arbiter.schemas.runtime.zmtp"]):
    from vram_arbiter.schemas.runtime.zmtp import (
        COMMAND_MAX_BYTES,
        ENVELOPE_MAX_BYTES,
        GREETING,
        READY,
        Event,
        Message,
        ServerConnection,
        WireLimits,
        ZmtpError,
    )

LIMITS = WireLimits(message_max_bytes=300, skip_max_bytes=1000)
GREETED = bytes.fromhex("ff00000000000000017f03014e554c4c") + bytes(48)
DEALER = b"\x04)\x05READY\x0bSocket-Type\x00\x00\x00\x06DEALER\x08Identity\x00\x00\x00\x00"
REQ = b"\x04&\x05READY\x0bSocket-Type\x00\x00\x00\x03REQ\x08Identity\x00\x00\x00\x00"
SEEDS = [
    GREETED + DEALER + b"\x00\x05hello\x04\x07\x04PING\x00\x00\x04\x05\x04PONG",
    GREETED + REQ + b"\x01\x00\x00\x05hello",
    GREETED + REQ + b"\x01\x04\x00\x00\x00\x07\x01\x00\x00\x05hello",
    GREETED + DEALER + b"\x02" + (400).to_bytes(8) + bytes(400) + b"\x00\x00",
    GREETED + DEALER + b"\x01\x01a\x00\x01b\x01\x00\x01\x00\x00\x01b",
    GREETED + DEALER + b"\x03" + (200).to_bytes(8) + bytes(200) + b"\x00\xc8" + bytes(200),
]


def read(data: bytes, pieces: int) -> list[Event | str]:
    """Everything that comes of `data`; a protocol error is the last entry."""
    connection = ServerConnection(LIMITS)
    found: list[Event | str] = []
    size = max(1, -(-len(data) // pieces))
    for at in range(0, len(data), size):
        connection.feed(data[at : at + size])
        try:
            while (event := connection.next_event()) is not None:
                found.append(
                    Message(bytes(event.payload), event.envelope)
                    if isinstance(event, Message)
                    else event
                )
        except ZmtpError:
            return [*found, "error"]
        if connection.kept_bytes > (
            LIMITS.message_max_bytes + COMMAND_MAX_BYTES + ENVELOPE_MAX_BYTES
        ):
            raise AssertionError(f"{connection.kept_bytes} bytes are kept")
        if len(connection.outgoing()) > len(GREETING) + len(READY) + 2 * size:
            raise AssertionError("the answer is longer than the question")
    return found


def feed(data: bytes) -> None:
    """One execution: greeted or not, whole and in pieces."""
    if not data:
        return
    pieces = data[0] % 64 + 1
    text = GREETED + DEALER + data[1:] if data[0] & 0x80 else data[1:]
    if (whole := read(text, 1)) != (cut := read(text, pieces)):
        raise AssertionError(f"{whole!r} in one piece, {cut!r} in {pieces}")


def main() -> None:
    arguments = list(sys.argv)
    with tempfile.TemporaryDirectory(prefix="corpus") as folder:
        if all(argument.startswith("-") for argument in arguments[1:]):
            for number, seed in enumerate(SEEDS):
                (Path(folder) / f"seed-{number}").write_bytes(bytes((number,)) + seed)
            arguments.append(folder)
        atheris.Setup(arguments, feed)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
