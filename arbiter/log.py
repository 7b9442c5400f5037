"""The daemon's log: one line per fact, for people or as JSON, on stderr.

Lines are worded and written by a thread of their own (`write_in_thread`): the event loop waits
neither for words nor for a reader of stderr. Must not know where the facts come from.
"""

import json
import logging
import queue
import threading
import time
from collections.abc import Callable

from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.logging import Form, PrintableFormatter, set_up
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.units import format_bytes
from vram_arbiter.schemas.wire.notes import WARNING_KINDS

events_log = logging.getLogger("arbiter.events")
refusals_log = logging.getLogger("arbiter.refusals")

_DETAILS = (
    "use_began", "use_ended", "reminded", "revoke_acked", "probe_ok",
    "refused",  # `RefusalLog` says it, with the client's name and user
)  # fmt: skip
_LEVELS = {
    **dict.fromkeys(WARNING_KINDS, logging.WARNING),
    **dict.fromkeys(_DETAILS, logging.DEBUG),
}
LINES_MAX = 10_000
"""Lines that wait for a reader of stderr. Those left out are counted, and the next line says how
many."""
CLOSE_S = 1.0

REFUSALS_BURST = 50
REFUSALS_PER_S = 5.0
"""Refusals of one user in the log, in the long run. Those left out are counted, and the next line
says how many."""
REFUSED_USERS_MAX = 256


class RefusalLog:
    """Refused requests in the log, with their reasons and without letting a user fill the disk with
    them."""

    def __init__(self, clock: Callable[[], float] = time.monotonic) -> None:
        self._clock = clock
        self._users: dict[int, tuple[float, float, int]] = {}  # uid → (budget, at, lines left out)

    def say(self, uid: int, pid: int, name: str, code: str, message: str) -> None:
        """`name`: what the client calls itself, "" before its hello."""
        now = self._clock()
        budget, at, left_out = self._users.pop(uid, (float(REFUSALS_BURST), now, 0))
        budget = min(float(REFUSALS_BURST), budget + (now - at) * REFUSALS_PER_S)
        if len(self._users) >= REFUSED_USERS_MAX:  # the user that was refused longest ago
            del self._users[next(iter(self._users))]
        if budget < 1:
            self._users[uid] = budget, now, left_out + 1
            return
        self._users[uid] = budget - 1, now, 0
        more = f" ({left_out} more before it are not shown)" if left_out else ""
        who = f"{name} (pid {pid}, uid {uid})" if name else f"pid {pid}, uid {uid}"
        refusals_log.info("refused %s: %s: %s%s", who, code, message, more)


def set_up_logging(form: Form, level: str) -> None:
    """Configure the root logger once, at the start of the daemon."""
    set_up(None, level, form, _Human())


class _Waiting(logging.Handler):
    """Lines that the log's thread has still to write."""

    def __init__(self) -> None:
        super().__init__()
        self.lines: queue.SimpleQueue[logging.LogRecord | None] = queue.SimpleQueue()
        self._left_out = 0

    def emit(self, record: logging.LogRecord) -> None:
        if self.lines.qsize() >= LINES_MAX:
            self._left_out += 1
            return
        if self._left_out:
            told = f"{self._left_out} lines are left out: the log was not read"
            facts = {"name": __name__, "levelno": 30, "levelname": "WARNING", "msg": told}
            self.lines.put(logging.makeLogRecord(facts))
            self._left_out = 0
        self.lines.put(record)


def write_in_thread() -> Callable[[], None]:
    """Let a thread write the log from here on. Call what is returned to write what is left, and
    from then on in the caller's thread again."""
    root, waiting = logging.getLogger(), _Waiting()
    before = list(root.handlers)

    def write() -> None:
        while (record := waiting.lines.get()) is not None:
            for handler in before:
                handler.handle(record)

    def close() -> None:
        root.handlers = before
        waiting.lines.put(None)
        thread.join(CLOSE_S)

    thread = threading.Thread(target=write, name="log", daemon=True)
    thread.start()
    root.handlers = [waiting]
    return close


class _Event(dict[str, object]):
    """An event of the history, in words where its line is written."""

    def __str__(self) -> str:
        return sentence(self)


def log_event(event: JsonMap) -> None:
    """One event of the history as one line of the log; as JSON with `trace_id` and `span_id` of its
    span, if it has one."""
    level = _LEVELS.get(event["kind"], logging.INFO)
    if events_log.isEnabledFor(level):
        said = _Event(event)
        events_log.log(level, "%s", said, extra={"event": said, "trace": _ids(event)})


def _ids(event: JsonMap) -> JsonMap:
    """Return the ids of the span that an event belongs to: the daemon's, else its acquirer's."""
    if "span_id" in event:
        return {key: event[key] for key in ("trace_id", "span_id")}
    parts = str(event.get("traceparent") or "").split("-")
    return {"trace_id": parts[1], "span_id": parts[2]} if len(parts) == 4 else {}


_UNSAID = frozenset(
    (
        *("seq", "at_wall_s", "kind", "lease_id", "consumer"),
        *("trace_id", "span_id", "parent_id", "trace_flags"),
    )
)
"""Fields of an event that its sentence begins with, or that are for programs."""


def sentence(event: JsonMap) -> str:
    """`granted L1-4 (detector): reason="fits", needed=4.94 GiB`"""
    parts = [
        f"{key.removesuffix('_bytes')}={_value(key, value)}"
        for key, value in event.items()
        if key not in _UNSAID
    ]
    words = [str(event["kind"]), *(str(event[key]) for key in ("lease_id",) if key in event)]
    if "consumer" in event:
        words.append(f"({event['consumer']})")
    return " ".join(words) + (": " + ", ".join(parts) if parts else "")


def _value(key: str, value: object) -> str:
    if key.endswith("_bytes") and isinstance(value, int):
        return format_bytes(value)
    if isinstance(value, float):
        return f"{value:.3f}".rstrip("0").rstrip(".")
    return json.dumps(value, default=str, ensure_ascii=False)


class _Human(PrintableFormatter):
    def format(self, record: logging.LogRecord) -> str:
        clock = time.strftime("%H:%M:%S", time.localtime(record.created))
        line = (
            f"{clock}.{int(record.msecs):03d} {record.levelname.lower():<8} {record.getMessage()}"
        )
        return printable(line) + (
            "\n" + self.formatException(record.exc_info) if record.exc_info else ""
        )
