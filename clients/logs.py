"""The log of the programs beside the daemon: a line a fact on stderr, for people or as JSON with the ids of the present span.

The JSON's keys are those of the daemon's log, and `program` says whose line it is.
"""

import json
import logging
import sys
from typing import Any, Literal

from vram_arbiter.schemas.runtime.logtext import PrintableFormatter

Form = Literal["human", "json"]
FORMS: tuple[Form, ...] = ("human", "json")


def set_up(program: str, level: str, form: Form, human: str) -> None:
    """Configure the root logger once, at the start of the program. `human`: the format of a line for people."""
    handler = logging.StreamHandler(sys.stderr)
    handler.setFormatter(_Json(program) if form == "json" else PrintableFormatter(human))
    root = logging.getLogger()
    for old in list(root.handlers):
        root.removeHandler(old)
    root.addHandler(handler)
    root.setLevel(level.upper())


class _Json(logging.Formatter):
    def __init__(self, program: str) -> None:
        super().__init__()
        self._program = program

    def format(self, record: logging.LogRecord) -> str:
        line: dict[str, Any] = {
            "at_wall_s": round(record.created, 6),
            "level": record.levelname.lower(),
            "logger": record.name,
            "message": record.getMessage(),
            "program": self._program,
            **_ids(),
        }
        if record.exc_info:
            line["exception"] = self.formatException(record.exc_info)
        return json.dumps(line, default=str)  # everything beyond ASCII is escaped


def _ids() -> dict[str, str]:
    if "opentelemetry.trace" not in sys.modules:
        return {}
    from vram_arbiter.schemas.runtime.telemetry import spans as tracing

    return tracing.log_ids()
