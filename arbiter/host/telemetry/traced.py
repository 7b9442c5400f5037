"""The daemon's telemetry put together, on the SDK that `schemas.runtime.telemetry.setup` has
installed. Imported only then."""

import asyncio
import logging
from collections.abc import Callable, Mapping, Sequence

from opentelemetry import metrics, trace

from vram_arbiter.arbiter.core.effects import Effect, Note
from vram_arbiter.arbiter.host.telemetry.metrics import LeaseMetrics, Picture
from vram_arbiter.arbiter.host.telemetry.spans import LeaseTelemetry
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.telemetry import names as names
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.wire.pushes import AnyPush

log = logging.getLogger(__name__)

_NONE: Mapping[str, str] = {}


class Harmless:
    """`LeaseTelemetry` that cannot stop the daemon: a defect in it is said once, and it is not
    asked again."""

    def __init__(self, leases: LeaseTelemetry) -> None:
        self._leases: LeaseTelemetry | None = leases

    def outgoing(self, effects: Sequence[Effect]) -> None:
        self._ask(lambda leases: leases.outgoing(effects), None)

    def revoke(self, body: AnyPush) -> AnyPush:
        return self._ask(lambda leases: leases.revoke(body), body)

    def observe(self, note: Note, event: JsonMap) -> Mapping[str, str]:
        return self._ask(lambda leases: leases.observe(note, event), _NONE)

    def wrote(self, seconds: float, *, failed: bool) -> None:
        self._ask(lambda leases: leases.wrote(seconds, failed=failed), None)

    def close(self) -> None:
        self._ask(lambda leases: leases.close(), None)

    def _ask[T](self, ask: Callable[[LeaseTelemetry], T], otherwise: T) -> T:
        if self._leases is None:
            return otherwise
        try:
            return ask(self._leases)
        except Exception:
            self._leases = None
            log.exception(
                "spans and numbers of leases end here: a defect of ours; leases go on as before"
            )
            return otherwise


class Traced:
    """`leases` goes to the executor; `watch` once the core is there, `close`
    before the SDK ends.

    The daemon's own run is a span beside what it serves, `cli.command`.
    """

    def __init__(self, traceparent: str | None = None, version: str = "") -> None:
        """`traceparent`: of the program that started the daemon. `version`: of the daemon."""
        self._command = tracing.begin(
            names.SPAN_COMMAND, traceparent, {names.ATTR_COMMAND: "serve"}
        )
        self._metrics = LeaseMetrics(metrics.get_meter(names.TRACER), version=version)
        self.leases = Harmless(LeaseTelemetry(trace.get_tracer(names.TRACER), self._metrics))

    def watch(self, loop: asyncio.AbstractEventLoop, read: Callable[[], Picture | None]) -> None:
        self._metrics.watch(loop, read)

    def close(self, code: int = 0, error: BaseException | None = None) -> None:
        """`code`: what the daemon exits with, unless it fails with `error`."""
        self._metrics.close()
        self.leases.close()
        if error is None:
            self._command.set_attribute(names.ATTR_EXIT_CODE, code)
        else:
            self._command.record_exception(error)
            self._command.set_status(trace.Status(trace.StatusCode.ERROR, str(error)))
        self._command.end()
