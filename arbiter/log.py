"""The daemon's log: one line per fact, for people or as JSON, on stderr. Must not know where the
facts come from."""

import json
import logging
import time
from collections.abc import Callable, Mapping
from typing import Any

from vram_arbiter.schemas.runtime.logging import Form, PrintableFormatter, set_up
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.units import format_bytes

events_log = logging.getLogger("arbiter.events")
refusals_log = logging.getLogger("arbiter.refusals")

_WARNINGS = frozenset(
    {
        "probe_failed",
        "pressure",
        "stowaway",
        "oom",
        "lost",
        "expired",
        "deadline_passed",
        "journal_put_aside",
        "record_stopped",
    }
)
_DETAILS = frozenset(
    {"use_began", "use_ended", "use_yielded", "reminded", "revoke_acked", "probe_ok", "refused"}
)
"""`refused`: `RefusalLog` says it, with the client's name and user."""


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


def level_of(kind: str) -> int:
    """How loud an event of the history is in the log."""
    if kind in _WARNINGS:
        return logging.WARNING
    return logging.DEBUG if kind in _DETAILS else logging.INFO


def log_event(event: Mapping[str, Any], trace: Mapping[str, str] | None = None) -> None:
    """One event of the history as one line of the log; as JSON with `trace_id` and `span_id` of its
    span, if it has one."""
    level = level_of(str(event["kind"]))
    if events_log.isEnabledFor(level):
        events_log.log(level, "%s", sentence(event), extra={"event": dict(event), "trace": trace})


def sentence(event: Mapping[str, Any]) -> str:
    """`granted L1-4 (detector): reason="fits", needed=4.94 GiB`"""
    skip = {"seq", "at_wall_s", "kind", "lease_id", "consumer"}
    parts = [
        f"{key.removesuffix('_bytes')}={_value(key, value)}"
        for key, value in event.items()
        if key not in skip
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
