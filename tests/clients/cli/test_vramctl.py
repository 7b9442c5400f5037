"""`vramctl` as a program: output, exit codes, and what its quick path imports."""

import json
import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.leases import Spec
from tests.support.process import ArbiterProcess, vramctl, vramctl_at_once
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.sync import Client

Finished = subprocess.CompletedProcess[str]


@pytest.fixture
def nowhere(tmp_path: Path) -> dict[str, str]:
    """An environment without an arbiter."""
    root = str(Path(__file__).parents[3])
    kept = {key: value for key, value in os.environ.items() if not key.startswith("VRAM_ARBITER_")}
    return {**kept, "VRAM_ARBITER_RUNTIME": str(tmp_path), "PYTHONPATH": f"{root}/src:{root}"}


# -- without a daemon
def test_the_path_of_status_imports_nothing_heavy(nowhere: dict[str, str]) -> None:
    code = (
        "import sys; sys.argv = ['vramctl', 'status']\n"
        "from vram_arbiter.clients.cli.main import main\n"
        "try: main()\n"
        "except SystemExit as end: assert end.code == 3, end.code\n"
        "import msgpack, zmq\n"
        "heavy = {'pydantic', 'asyncio', 'opentelemetry', 'rich', 'textual', 'yaml', 'numpy'}\n"
        "heavy &= set(sys.modules)\n"
        "assert not heavy, heavy\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], env=nowhere, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr


@pytest.mark.e2e
def test_3_without_an_arbiter(nowhere: dict[str, str]) -> None:
    run = ["run", "--vram", "1GiB", "true"]
    commands = (["status"], ["why", "x"], ["history"], ["history", "-f"], run)
    for command, done in vramctl_at_once(commands, environ=nowhere):
        assert done.returncode == 3, command
        assert "VRAM_ARBITER_ENDPOINT" in done.stderr, command
        assert "Traceback" not in done.stderr, command


def test_errors_are_json_where_json_was_asked_for(nowhere: dict[str, str]) -> None:
    done = vramctl("status", "--json", environ=nowhere)
    assert (done.returncode, json.loads(done.stdout)["error"]["code"]) == (3, "arbiter_unreachable")


def test_help_names_every_command_and_the_exit_codes(nowhere: dict[str, str]) -> None:
    done = vramctl("--help", environ=nowhere)
    assert done.returncode == 0
    for word in ("status", "why", "history", "run", "doctor", "demo", "Exit codes: 0 done"):
        assert word in done.stdout


COMMANDS = {
    "clients": (
        "", "status", "why", "history", "top", "evict", "pin", "unpin", "drain", "resume",
        "release-dead", "run", "doctor", "mcp", "replay", "demo", "fleet",
    ),
    "runner": ("", "sim", "deploy", "estop"),
    "arbiter": ("",), "arbiter.offline": ("replay",), "sidecars": ("",), "reasoner": ("",),
    "schemas": ("", "check"), "testing": ("",),
}  # fmt: skip
RUN_EACH = """
import contextlib, io, json, runpy, sys
said = {}
for line in json.loads(sys.argv[1]):
    sys.argv, out = line, io.StringIO()
    with contextlib.redirect_stdout(out), contextlib.suppress(SystemExit):
        runpy.run_module(line[0], run_name='__main__')
    said[' '.join(line)] = out.getvalue()
print(json.dumps(said))
"""


def test_every_program_and_command_has_help_and_version(nowhere: dict[str, str]) -> None:
    """`vramctl -h` was wrong usage, and only the daemon had `--version`."""
    lines = [
        [f"vram_arbiter.{program}", *filter(None, [command]), flag]
        for program, commands in COMMANDS.items()
        for command in commands
        for flag in ("-h", "--version")
    ]
    done = subprocess.run(
        [sys.executable, "-c", RUN_EACH, json.dumps(lines)],
        env=nowhere, capture_output=True, text=True, timeout=PATIENCE_S, check=False,
    )  # fmt: skip
    assert done.returncode == 0, done.stderr
    wanted = {"-h": "sage: ", "--version": "vram-arbiter "}
    through_a_program = "vram_arbiter.clients replay "
    wrong = {
        line: said for line, said in json.loads(done.stdout.splitlines()[-1]).items()
        if wanted[line.split()[-1]] not in said and not line.startswith(through_a_program)
    }  # fmt: skip
    assert wrong == {}


def test_help_uses_the_width_of_the_terminal(nowhere: dict[str, str]) -> None:
    """It stopped at 80 columns."""
    wide = vramctl("status", "--help", environ={**nowhere, "COLUMNS": "150"}).stdout
    assert "socket of the arbiter (environment: VRAM_ARBITER_ENDPOINT)" in wide


@pytest.mark.e2e
def test_doctor_without_an_arbiter(nowhere: dict[str, str]) -> None:
    done = vramctl("doctor", "--json", environ=nowhere)
    findings = {one["code"]: one for one in json.loads(done.stdout)["findings"]}
    assert done.returncode == 3
    assert findings["socket.missing"]["severity"] == "error"


@pytest.mark.e2e
def test_a_socket_that_nobody_serves(nowhere: dict[str, str]) -> None:
    import zmq

    endpoint = f"ipc://{nowhere['VRAM_ARBITER_RUNTIME']}/s"
    with zmq.Context() as context, context.socket(zmq.ROUTER) as mute:
        mute.bind(endpoint)
        done = vramctl("status", environ={**nowhere, "VRAM_ARBITER_ENDPOINT": endpoint})
    assert done.returncode == 3
    assert "no arbiter answers" in done.stderr


# -- with a daemon
@pytest.mark.e2e
def test_status_why_history(client: Client, arbiter_daemon: ArbiterProcess, spec: Spec) -> None:
    environ = arbiter_daemon.environ
    lease = client.acquire(spec("detector", 5))
    lease.ready()
    shown = vramctl("status", environ=environ)
    assert shown.returncode == 0
    assert f"{lease.lease_id}  detector  detector  held, idle   5 GiB" in shown.stdout
    status = json.loads(vramctl("status", "--json", environ=environ).stdout)
    wanted = {
        "epoch",
        "phase",
        "uptime_s",
        "gpus",
        "leases",
        "clients",
        "drained",
        "problems",
        "host_ram",
        "totals",
        "daemon",
    }
    assert set(status) == wanted
    assert status["leases"][0]["consumer"] == "detector"

    why = vramctl("why", "detector", environ=environ)
    assert (why.returncode, why.stdout.splitlines()[1]) == (
        0,
        f"  lease     {lease.lease_id}, held",
    )
    nobody = vramctl("why", "nobody", "--json", environ=environ)
    assert (nobody.returncode, json.loads(nobody.stdout)) == (
        1,
        {"consumer": "nobody", "leases": []},
    )

    told = vramctl("history", "--all", environ=environ).stdout
    kinds = [line.split()[2] for line in told.splitlines()]
    assert kinds[0] == "started"
    assert [kind for kind in kinds if kind in ("granted", "ready", "switch")] == [
        "granted",
        "ready",
        "switch",
    ]
    newest = json.loads(
        vramctl("history", "-n", "1", "-c", "detector", "--json", environ=environ).stdout
    )
    assert [event["kind"] for event in newest["events"]] == ["switch"]
    granted = json.loads(vramctl("history", "--kind", "granted", "--json", environ=environ).stdout)
    assert [event["consumer"] for event in granted["events"]] == ["detector"]


@pytest.mark.e2e
def test_an_operators_actions(client: Client, arbiter_daemon: ArbiterProcess, spec: Spec) -> None:
    environ = arbiter_daemon.environ
    lease = client.acquire(spec("detector", 5))
    lease.ready()
    pinned = vramctl("pin", "detector", "-r", "press demo", environ=environ)
    assert (pinned.returncode, "is pinned" in pinned.stdout) == (0, True)
    refused = vramctl("evict", "detector", "-r", "make room", "--json", environ=environ)
    assert (refused.returncode, json.loads(refused.stdout)["error"]["code"]) == (1, "bad_state")
    assert "press demo" in vramctl("status", "--json", environ=environ).stdout
    assert vramctl("unpin", lease.lease_id, environ=environ).returncode == 0
    evicted = vramctl("evict", lease.lease_id, "--reason", "make room", environ=environ)
    assert evicted.stdout.startswith(f"detector ({lease.lease_id}) was revoked: it unloads now")

    drained = vramctl("drain", "-r", "new driver", environ=environ)
    assert (drained.returncode, "new driver" in drained.stdout) == (0, True)
    assert "nothing is granted until `vramctl resume`" in vramctl("status", environ=environ).stdout
    assert "drain" in vramctl("history", "--json", environ=environ).stdout  # it is on the disk
    arbiter_daemon.kill()
    arbiter_daemon.start()
    assert (
        "new driver" in json.loads(vramctl("status", "--json", environ=environ).stdout)["drained"]
    )
    assert vramctl("resume", environ=environ).stdout == "grants resumed\n"
    unknown = vramctl("release-dead", "nobody", "-r", "gone", environ=environ)
    assert (unknown.returncode, "no lease or consumer" in unknown.stderr) == (1, True)
    listed = json.loads(vramctl("history", "--kind", "operator", "--json", environ=environ).stdout)[
        "events"
    ]
    assert [event["action"] for event in listed] == ["pin", "unpin", "evict", "drain", "resume"]
    assert all("vramctl (uid" in event["by"] for event in listed)


@pytest.mark.e2e
def test_doctor_fails_on_a_drained_daemon(make_arbiter: Callable[..., ArbiterProcess]) -> None:
    """It grants nothing, and doctor exited 0."""
    arbiter = make_arbiter().start()
    assert vramctl("drain", "-r", "service", environ=arbiter.environ).returncode == 0
    done = vramctl("doctor", environ=arbiter.environ)
    assert done.returncode == 1
    assert "ERROR    daemon.drained" in done.stdout
    assert "→ vramctl resume" in done.stdout
    assert vramctl("resume", environ=arbiter.environ).returncode == 0
    assert vramctl("doctor", environ=arbiter.environ).returncode == 0


@pytest.mark.e2e
def test_doctor_with_a_daemon(arbiter_daemon: ArbiterProcess) -> None:
    done = vramctl("doctor", environ=arbiter_daemon.environ)
    assert done.returncode == 0, done.stdout
    assert "its probe answers (source fake)" in done.stdout, "what reads the GPU is said"
