"""`cli.command`: how a program's life and end are recorded, also when a signal ends it, and that
nothing is when nobody asked."""

import signal
import socket
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.collector import Collector
from tests.support.paths import ROOT
from vram_arbiter.schemas.runtime.telemetry import names as telemetry

pytestmark = pytest.mark.heavy  # the OpenTelemetry SDK

TRACE, PARENT = "0af7651916cd43dd8448eb211c80319c", "b7ad6b7169203331"
WAIT_S = 60.0


def ran(*arguments: str, **environ: str) -> "subprocess.CompletedProcess[str]":
    """Run an interpreter to its end."""
    return subprocess.run(
        [sys.executable, *arguments],
        env={"PYTHONPATH": f"{ROOT}/src:{ROOT}", "PATH": "/usr/bin", **environ},
        capture_output=True,
        text=True,
        timeout=WAIT_S,
    )


def port_of(taken: socket.socket) -> dict[str, str]:
    """Return the variables that ask for Prometheus on a port."""
    port = str(taken.getsockname()[1])
    return {"OTEL_METRICS_EXPORTER": "prometheus", "OTEL_EXPORTER_PROMETHEUS_PORT": port}


def program(lines: str, collector: Collector | None, **environ: str) -> "subprocess.Popen[str]":
    """A program of these lines inside `command("tool", "do")`; `serves` and `sys` are at hand."""
    body = "\n".join(f"    {line}" for line in lines.splitlines())
    code = (
        "import signal, sys\nfrom vram_arbiter.schemas.runtime.telemetry.commands import "
        f"command\nwith command('tool', 'do') as running:\n{body}\n"
    )
    given = {
        "PYTHONPATH": f"{ROOT}/src:{ROOT}",
        "PATH": "/usr/bin",
        **(collector.environ() if collector else {}),
        **environ,
    }
    return subprocess.Popen(
        [sys.executable, "-c", code],
        env=given,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.parametrize(
    ("lines", "code"),
    [
        ("pass", 0),
        ("running.code = 3", 3),
        ("sys.exit(4)", 4),
        ("sys.exit('no')", 1),
        ("raise RuntimeError('broken')", 1),
    ],
)
def test_the_end_of_a_command_is_recorded(lines: str, code: int) -> None:
    with Collector() as collector:
        process = program(lines, collector, TRACEPARENT=f"00-{TRACE}-{PARENT}-01")
        process.communicate(timeout=WAIT_S)
        (span,) = collector.spans(telemetry.SPAN_COMMAND)
    assert span.attributes[telemetry.ATTR_EXIT_CODE] == code
    assert span.attributes[telemetry.ATTR_COMMAND] == "do"
    assert (span.service, span.trace_id, span.parent_id) == ("tool", TRACE, PARENT), (
        "it joins who started it"
    )
    assert [event.name for event in span.events] == (["exception"] if "raise" in lines else [])


def test_sigterm_loses_nothing() -> None:
    with Collector() as collector:
        process = program("print('up', flush=True)\nsignal.pause()", collector)
        assert process.stdout is not None
        assert process.stdout.readline() == "up\n"
        process.send_signal(signal.SIGTERM)
        process.communicate(timeout=WAIT_S)
        (span,) = collector.spans(telemetry.SPAN_COMMAND)
    assert process.returncode == span.attributes[telemetry.ATTR_EXIT_CODE] == 128 + signal.SIGTERM


def test_nobody_asked_nothing_is_imported_or_changed() -> None:
    process = program(
        "print([name for name in sys.modules if name.startswith('opentelemetry')], "
        "signal.getsignal(signal.SIGTERM) is signal.SIG_DFL)",
        None,
    )
    out, err = process.communicate(timeout=WAIT_S)
    assert (out, err) == ("[] True\n", "")


def test_variables_that_make_no_sense_are_told_in_one_line(tmp_path: Path) -> None:
    """Each program says it before it does anything."""
    for argv in (
        ("clients", "history"),
        ("reasoner", "--say", "x"),
        ("runner", "replay", "--dataset", "x", "--frame", "0"),
    ):
        done = ran(
            *("-m", f"vram_arbiter.{argv[0]}", *argv[1:]),
            OTEL_TRACES_EXPORTER="smoke",
            VRAM_ARBITER_RUNTIME=str(tmp_path),
        )
        assert done.returncode == 2, done.stderr
        assert "OTEL_" in done.stderr
        assert "Traceback" not in done.stderr


def test_a_command_goes_on_where_a_server_has_the_port(tmp_path: Path) -> None:
    """A variable for all programs of the machine: `vramctl evict` and `vram-runner goal` were
    refused for the port that the runner serves its metrics on."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        environ = {"VRAM_ARBITER_RUNTIME": str(tmp_path), **port_of(taken)}
        for argv, code, answer in (
            (("clients", "drain", "--reason", "x"), 3, "no arbiter"),
            (("runner", "goal", "a/grab", "grab", "--wait", "0.1"), 1, "no runner"),
            (("reasoner", "serve"), 2, "no Prometheus endpoint"),
        ):
            done = ran("-m", f"vram_arbiter.{argv[0]}", *argv[1:], **environ)
            assert (done.returncode, answer in done.stderr) == (code, True), done.stderr


def test_an_emergency_stop_is_not_refused_for_the_telemetrys_sake(tmp_path: Path) -> None:
    """A variable for all programs of the machine; and the port that it names is the runner's own,
    whose robot shall stop."""
    with socket.create_server(("127.0.0.1", 0)) as taken:
        for said in ({"OTEL_EXPORTER_OTLP_ENDPOINT": "collector"}, port_of(taken)):
            estop = ("estop", "--endpoint", f"ipc://{tmp_path}/runner.sock")
            done = ran("-m", "vram_arbiter.runner", *estop, **said)
            assert done.returncode == 1, done.stderr
            assert "no runner stops at" in done.stderr, "it asked"


def test_the_quick_commands_send_nothing_and_the_others_do(tmp_path: Path) -> None:
    """`vramctl status` is typed and polled too often to pay for an SDK."""
    with Collector() as collector:
        lines = (
            "import sys\nfrom vram_arbiter.clients.cli.main import main\nsys.argv = ['vramctl', "
            "*sys.argv[1:]]\n"
            "try: main()\nfinally: print([name for name in sys.modules if name == "
            "'opentelemetry'], file=sys.stderr)"
        )
        said = {}
        for name in ("status", "doctor"):
            environ = {"VRAM_ARBITER_RUNTIME": str(tmp_path), **collector.environ()}
            done = ran("-c", lines, name, **environ)
            said[name] = (done.returncode, done.stderr.splitlines()[-1])
        spans = collector.spans()
    assert said == {"status": (3, "[]"), "doctor": (3, "['opentelemetry']")}
    (span,) = spans
    assert (span.service, span.name) == ("vramctl", telemetry.SPAN_COMMAND)
    assert (span.attributes[telemetry.ATTR_COMMAND], span.attributes[telemetry.ATTR_EXIT_CODE]) == (
        "doctor",
        3,
    )
