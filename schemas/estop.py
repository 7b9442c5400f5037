"""The emergency stop's own wire: one packet asks, two packets answer, on a SOCK_SEQPACKET Unix
socket beside the goal socket.

    client                    runner
    VRAM-ESTOP/1 [reason]  →
                           ←  latched | already: from now on nothing is sent to the motors
                           ←  obeyed | not_told | hung: what became of the motors; then it hangs up

The packets are text, so that a button's program or a shell can stop a robot. No library reads them:
nothing that a peer sends costs more than a copy of `REQUEST_MAX_BYTES`.
"""

from dataclasses import dataclass
from enum import StrEnum

from vram_arbiter.schemas.errors import BadFrame
from vram_arbiter.schemas.runtime.endpoints import socket_path

SUFFIX = ".estop"
PREFIX = b"VRAM-ESTOP/"
VERSION = b"1"
REASON_MAX_CHARS = 500
TEXT_MAX_CHARS = 2000  # of a reply: the reason, and what a driver says of its motors
REQUEST_MAX_BYTES = 4096
REPLY_MAX_BYTES = 16_384
_SEPARATOR = "\t"


class Answer(StrEnum):
    """First word of a reply. `LATCHED` and `ALREADY` come at once, one of the others after the
    control loop's next tick.
    """

    LATCHED = "latched"
    ALREADY = "already"  # an earlier stop is in force; its reason and its time stand in the reply
    OBEYED = "obeyed"
    NOT_TOLD = "not_told"  # the motors did not take the command; the runner goes on telling them
    HUNG = "hung"  # the control loop has not looked; it sends nothing when it comes back


@dataclass(frozen=True, slots=True)
class Reply:
    """One packet of the runner's. `stopped_ns` is the monotonic time of the first stop, `text` its
    reason or what became of it.
    """

    answer: Answer
    stopped_ns: int
    robot: str
    text: str

    def encode(self) -> bytes:
        fields = (
            self.answer.value,
            str(self.stopped_ns),
            one_line(self.robot),
            one_line(self.text, TEXT_MAX_CHARS),
        )
        line = _SEPARATOR.join(fields).encode(errors="replace")[: REPLY_MAX_BYTES - 16]
        return PREFIX + VERSION + _SEPARATOR.encode() + line


def path_of(endpoint: str) -> str:
    """Path of the emergency-stop socket of the runner that serves goals at `endpoint`. Raises
    ConfigError for what is no `ipc://` endpoint.
    """
    socket_path(endpoint)  # its own mistakes are said in its own words
    return socket_path(endpoint + SUFFIX)


def request(reason: str) -> bytes:
    """The packet that stops. Words that UTF-8 has no bytes for are escaped, long ones cut: a stop
    is not refused for its words.
    """
    words = one_line(reason.encode(errors="backslashreplace").decode())
    return b" ".join((PREFIX + VERSION, words.encode())).strip()


def reason_in(packet: bytes) -> str | None:
    """Reason of a request, possibly empty; None where the packet is not a request. Any version
    stops."""
    if not packet.startswith(PREFIX):
        return None
    return one_line(packet.partition(b" ")[2].decode(errors="replace"))


def reply_in(packet: bytes) -> Reply:
    """Raises BadFrame for a packet that is not a reply."""
    words = packet.decode(errors="replace").split(_SEPARATOR, 4)
    try:
        version, answer, stopped_ns, robot, text = words
        if not version.startswith(PREFIX.decode()):
            raise ValueError("it does not begin with VRAM-ESTOP/")
        return Reply(Answer(answer), int(stopped_ns), robot, text)
    except ValueError as error:
        raise BadFrame(
            f"not a reply of an emergency stop: {packet[:64]!r}", hint="is this a runner's socket?"
        ) from error


def one_line(text: str, most: int = REASON_MAX_CHARS) -> str:
    """Printable characters of `text`, at most `most`; others become spaces."""
    return "".join(c if c.isprintable() else " " for c in text[: 4 * most]).strip()[:most]
