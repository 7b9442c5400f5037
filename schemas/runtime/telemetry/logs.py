"""Log records to a collector: a handler of the standard library's `logging` on the SDK's logs.

The SDK's own handler is deprecated, and one undecodable text in it would lose a whole batch.
The SDK is imported only where logs are exported.
"""

import logging
import time
from collections.abc import Callable, Sequence
from typing import TYPE_CHECKING, Any

from opentelemetry._logs import LogRecord, SeverityNumber, set_logger_provider
from opentelemetry.context import get_current

from vram_arbiter.schemas.runtime.telemetry import exported
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

if TYPE_CHECKING:
    from opentelemetry.sdk._logs import LoggerProvider
    from opentelemetry.sdk.resources import Resource

OWN = ("opentelemetry", "urllib3", "requests")
"""Loggers of the export itself: a collector that is away must not be told so, again and again."""
_SEVERITIES = {
    logging.DEBUG: (SeverityNumber.DEBUG, "DEBUG"),
    logging.INFO: (SeverityNumber.INFO, "INFO"),
    logging.WARNING: (SeverityNumber.WARN, "WARN"),
    logging.ERROR: (SeverityNumber.ERROR, "ERROR"),
    logging.CRITICAL: (SeverityNumber.FATAL, "FATAL"),
}


def install(resource: "Resource", exporters: Sequence[Any]) -> Callable[[], object]:
    """Send what the root logger gets to the exporters. Returns what ends it."""
    from opentelemetry.sdk._logs import LoggerProvider
    from opentelemetry.sdk._logs.export import BatchLogRecordProcessor

    provider = LoggerProvider(resource=resource, shutdown_on_exit=False)
    for exporter in exporters:
        provider.add_log_record_processor(BatchLogRecordProcessor(exporter))
    set_logger_provider(provider)
    handler = OtlpHandler(provider)
    logging.getLogger().addHandler(handler)

    def end() -> None:
        logging.getLogger().removeHandler(handler)
        provider.shutdown()

    return end


class OtlpHandler(logging.Handler):
    """Hands each record to the SDK, which sends it from a thread of its own."""

    def __init__(self, provider: "LoggerProvider") -> None:
        super().__init__()
        self._provider = provider

    def emit(self, record: logging.LogRecord) -> None:
        if record.name.partition(".")[0] in OWN:
            return
        try:
            self._provider.get_logger(record.name).emit(converted(record))
        except Exception:  # noqa: BLE001 - a log line must not fail the program
            self.handleError(record)


def converted(record: logging.LogRecord) -> LogRecord:
    """Return the record as OpenTelemetry's, with the present span."""
    number, word = _SEVERITIES.get(record.levelno, (SeverityNumber.UNSPECIFIED, record.levelname))
    attributes: dict[str, str | int] = {
        "code.function.name": record.funcName or "",
        "code.line.number": record.lineno,
    }
    if record.exc_info and (error := record.exc_info[1]) is not None:
        attributes[telemetry.ATTR_EXCEPTION_TYPE] = type(error).__qualname__
        attributes[telemetry.ATTR_EXCEPTION_MESSAGE] = str(error)
        stacktrace = logging.Formatter().formatException(record.exc_info)
        attributes[telemetry.ATTR_EXCEPTION_STACKTRACE] = stacktrace
    return LogRecord(
        timestamp=int(record.created * 1e9),
        observed_timestamp=time.time_ns(),
        context=get_current(),
        severity_text=word,
        severity_number=number,
        body=exported.text(record.getMessage()),
        attributes=dict(exported.attributes(attributes)),
    )
