"""A program from its start to its end, as the span `cli.command`: telemetry is set up before, and
sent off after, however it ends.

What a command does (`vramctl run`, a reasoner's task, a benchmark) is in its trace. A server's
command is a span of its own beside the traces of those it serves: they would otherwise be one trace
for as long as it runs. A program that was started inside a trace (W3C `TRACEPARENT` in its
environment) joins it.
"""

import os
import signal
import sys
import threading
from collections.abc import Iterator, Mapping
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from types import FrameType

from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import setup as otel

TRACEPARENT_VARIABLE = "TRACEPARENT"


@dataclass(slots=True)
class Command:
    """What is under way; set `code`, the exit code, where no SystemExit says it."""

    code: int = 0


@contextmanager
def command(
    program: str,
    name: str,
    *,
    serves: bool = False,
    attributes: Mapping[str, str] | None = None,
    flush_s: float = otel.FLUSH_S,
) -> Iterator[Command]:
    """Run a program's work inside. `program` is the service's name, `name` the command;
    `attributes` go to all that it sends.

    Without telemetry it does nothing and imports nothing. With it, SIGTERM ends a program that does
    not handle it by SystemExit(143), so that what it recorded is sent. Raises ConfigError for OTEL_
    variables that make no sense, before any work is done.
    """
    running = Command()
    # the port of a machine-wide variable is a server's; a command asks nothing of it
    installed = otel.set_up(program, attributes=attributes, port_required=serves)
    if not installed.on:
        yield running
        return
    from vram_arbiter.schemas.runtime.telemetry import spans as tracing

    # only the main thread may set handlers
    in_main = threading.current_thread() is threading.main_thread()
    if in_main and signal.getsignal(signal.SIGTERM) is signal.SIG_DFL:
        signal.signal(signal.SIGTERM, _terminated)
    span = tracing.begin(
        telemetry.SPAN_COMMAND, os.environ.get(TRACEPARENT_VARIABLE), {telemetry.ATTR_COMMAND: name}
    )
    try:
        with nullcontext() if serves else tracing.inside(span):
            yield running
    except SystemExit as end:
        running.code = end.code if isinstance(end.code, int) else int(end.code is not None)
        raise
    except KeyboardInterrupt:
        running.code = 128 + signal.SIGINT
        raise
    except BaseException as error:
        running.code = running.code or 1
        span.record_exception(error)
        raise
    finally:
        span.set_attribute(telemetry.ATTR_EXIT_CODE, running.code)
        span.end()
        installed(flush_s)


def _terminated(number: int, frame: FrameType | None) -> None:
    sys.exit(128 + number)
