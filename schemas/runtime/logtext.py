"""Log lines for people: nothing that a message quotes reaches the terminal as a control, or as another line."""

import logging
from types import TracebackType

from vram_arbiter.schemas.runtime.printable import printable, printable_lines


class PrintableFormatter(logging.Formatter):
    """A message is one line; tracebacks keep theirs."""

    def formatMessage(self, record: logging.LogRecord) -> str:
        return printable(super().formatMessage(record))

    def formatException(
        self,
        ei: tuple[type[BaseException], BaseException, TracebackType | None]
        | tuple[None, None, None],
    ) -> str:
        return printable_lines(super().formatException(ei))
