"""The log of every program: one line per fact on stderr, for people or as JSON."""

import logging
import sys
from types import TracebackType
from typing import Literal

from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.printable import printable, printable_lines

Form = Literal["human", "json"]
FORMS: tuple[Form, ...] = ("human", "json")


class PrintableFormatter(logging.Formatter):
    """Lines for people. A message is one line without control characters; tracebacks keep theirs.

    What a message quotes (file names, clients' names) reaches the terminal neither as a control
    sequence nor as another line.
    """

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))

    def formatException(
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None]
        | tuple[None, None, None],
    ) -> str:
        return printable_lines(super().formatException(ei))


def set_up(program: str | None, level: str, form: Form, human: str | logging.Formatter) -> None:
    """Configure the root logger once, at the start of a program.

    Args:
        program: name on every line of `form` "json"; None for the daemon.
        human: format of the lines of `form` "human".
    """
    handler = logging.StreamHandler(sys.stderr)
    people = PrintableFormatter(human) if isinstance(human, str) else human
    handler.setFormatter(_json(program) if form == "json" else people)
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())


def _json(program: str | None) -> logging.Formatter:
    """Return a formatter of one JSON object per line, with the ids of the span where there is one.

    Keys: at_wall_s, level, logger, message, program, event, trace_id, span_id, exception.
    """
    from pythonjsonlogger.json import JsonFormatter

    class Lines(JsonFormatter):
        def add_fields(
            self,
            log_data: JsonObject,
            record: logging.LogRecord,
            message_dict: JsonObject,
        ) -> None:
            log_data["at_wall_s"] = round(record.created, 6)
            log_data["level"] = record.levelname.lower()
            log_data["logger"] = record.name
            log_data["message"] = record.getMessage()
            if program is not None:
                log_data["program"] = program
            if (event := getattr(record, "event", None)) is not None:
                log_data["event"] = event
            log_data.update(getattr(record, "trace", None) or _span_ids())
            if record.exc_info:
                log_data["exception"] = self.formatException(record.exc_info)

    return Lines(json_ensure_ascii=True)


def _span_ids() -> dict[str, str]:
    """Return the ids of the current span; a program without telemetry imports nothing for it."""
    if "opentelemetry.trace" not in sys.modules:
        return {}
    from vram_arbiter.schemas.runtime.telemetry import spans

    return spans.log_ids()
