"""`cli.command`: how a program's life and end are recorded, also when a signal ends it, and that
nothing is when nobody asked."""

import signal
import socket
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.support.collector import Collector
from tests.support.paths import ROOT
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.cli.main import main as vramctl
from vram_arbiter.reasoner.__main__ import main as reasoner
from vram_arbiter.runner.__main__ import main as runner
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import setup as otel
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.runtime.telemetry.commands import Command, command

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
PROGRAMS = {"vramctl": vramctl, "vram-runner": runner, "vram-reasoner": reasoner}


@pytest.fixture
def ran(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> Callable[..., tuple[object, str]]:
    """Run a program here, with these variables. Returns its exit code and what it said."""
    monkeypatch.setenv("VRAM_ARBITER_RUNTIME", str(tmp_path))
    monkeypatch.setattr(otel, "_installed", None)

    def run(words: str, **environ: str) -> tuple[object, str]:
        monkeypatch.setattr(sys, "argv", words.format(here=tmp_path).split())
        for name, value in environ.items():
            monkeypatch.setenv(name, value)
        with pytest.raises(SystemExit) as ended:
            sys.exit(PROGRAMS[sys.argv[0]]())
        return ended.value.code, capsys.readouterr().err

    return run


def port_of(taken: socket.socket) -> dict[str, str]:
    """Return the variables that ask for Prometheus on a port."""
    port = str(taken.getsockname()[1])
    return {"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_PORT": port}


def program(lines: str, **environ: str) -> "subprocess.Popen[str]":
    """A program of these lines inside `command("tool", "do")`."""
    code = (
        "import signal, sys, threading\n"
        "from vram_arbiter.schemas.runtime.telemetry.commands import command\n"
        f"with command('tool', 'do'):\n    {lines}\n"
    )
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env={"PYTHONPATH": f"{ROOT}/src:{ROOT}", "PATH": "/usr/bin", **environ},
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.fixture
def exported_spans(monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """Exporter of the spans of this process, as if the environment asked for them."""
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(tracing, "_TRACER", provider.get_tracer("test"))
    monkeypatch.setattr(otel, "set_up", lambda *_, **__: otel.Telemetry([exporter.force_flush]))
    before = signal.getsignal(signal.SIGTERM)
    yield exporter
    signal.signal(signal.SIGTERM, before)


def raising(error: BaseException) -> Callable[[Command], None]:
    def ends(_: Command) -> None:
        raise error

    return ends


@pytest.mark.parametrize(
    ("ends", "code"),
    [
        (lambda running: None, 0),
        (lambda running: setattr(running, "code", 3), 3),
        (raising(SystemExit(4)), 4),
        (raising(SystemExit("no")), 1),
        (raising(KeyboardInterrupt()), 130),
        (raising(RuntimeError("broken")), 1),
    ],
)
def test_the_end_of_a_command_is_recorded(
    exported_spans: Any, ends: Callable[[Command], None], code: int
) -> None:
    try:
        with command("tool", "do") as running:
            ends(running)
    except BaseException as error:  # noqa: BLE001 - it is what the command ended with
        failed = isinstance(error, RuntimeError)
    else:
        failed = False
    (span,) = exported_spans.get_finished_spans()
    assert span.attributes == {telemetry.ATTR_COMMAND: "do", telemetry.ATTR_EXIT_CODE: code}
    assert [event.name for event in span.events] == ["exception"] * failed


def test_sigterm_loses_nothing_and_the_trace_is_the_starters() -> None:
    with Collector() as collector:
        given = {"TRACEPARENT": f"00-{TRACE}-{PARENT}-01", **collector.environ()}
        process = program("print('up', flush=True); signal.pause()", **given)
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=PATIENCE_S)
        (span,) = collector.spans(telemetry.SPAN_COMMAND)
    assert process.returncode == span.attributes[telemetry.ATTR_EXIT_CODE] == 128 + signal.SIGTERM
    assert (span.service, span.trace_id, span.parent_id) == ("tool", TRACE, PARENT)


def test_unasked_nothing_is_imported_or_changed() -> None:
    process = program(
        "print([name for name in sys.modules if name.startswith('opentelemetry')],"
        " signal.getsignal(signal.SIGTERM) is signal.SIG_DFL, threading.active_count())"
    )
    assert process.communicate(timeout=PATIENCE_S) == ("[] True 1\n", "")


@pytest.mark.parametrize(
    "words",
    ["vramctl history", "vram-reasoner --say x", "vram-runner replay --dataset x --frame 0"],
)
def test_variables_that_make_no_sense_are_told_in_one_line(
    ran: Callable[..., tuple[object, str]], words: str
) -> None:
    """Each program says it before it does anything."""
    code, said = ran(words, OTEL_TRACES_EXPORTER="smoke")
    assert code == 2
    assert "OTEL_" in said


@pytest.mark.parametrize(
    ("words", "code", "answer"),
    [
        ("vramctl drain --reason x", 3, "no arbiter"),
        ("vram-runner goal a/grab grab --wait 0.1", 1, "no runner"),
        ("vram-reasoner serve", 2, "no Prometheus endpoint"),
        ("vram-runner estop --endpoint ipc://{here}/runner.sock", 1, "no runner stops at"),
    ],
)
def test_a_command_goes_on_where_a_server_has_the_port(
    ran: Callable[..., tuple[object, str]], words: str, code: int, answer: str
) -> None:
    """A variable for all programs of the machine: `vramctl evict` and `vram-runner goal` were
    refused for the port that the runner serves its metrics on."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        ended, said = ran(words, **port_of(taken))
    assert (ended, answer in said) == (code, True), said


def test_an_emergency_stop_is_not_refused_for_the_telemetrys_sake(
    ran: Callable[..., tuple[object, str]],
) -> None:
    words = "vram-runner estop --endpoint ipc://{here}/runner.sock"
    code, said = ran(words, OTEL_EXPORTER_OTLP_ENDPOINT="collector")
    assert (code, "no runner stops at" in said) == (1, True), said


def test_the_quick_commands_send_nothing_and_the_others_do(
    ran: Callable[..., tuple[object, str]], monkeypatch: pytest.MonkeyPatch
) -> None:
    """`vramctl status` is typed and polled too often to pay for an SDK."""
    asked: list[str] = []

    def set_up(service: str, **_: Any) -> otel.Telemetry:
        asked.append(service)
        return otel.Telemetry()

    monkeypatch.setattr(otel, "set_up", set_up)
    assert ran("vramctl status", OTEL_SERVICE_NAME="robot")[0] == 3
    assert asked == []
    assert ran("vramctl doctor")[0] == 3
    assert asked == ["vramctl"]
