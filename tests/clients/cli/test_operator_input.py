"""What an operator may mistype, meet or forget: one line that says what is wrong and what to do,
and the documented exit code.

Real daemon, real programs. The table of exit codes is in docs/reference/exit-codes.md.
"""

import grp
import json
import os
import signal
from pathlib import Path

import pytest

from tests.support.leases import Spec
from tests.support.process import ArbiterProcess, Finished, vramctl, vramctl_at_once
from vram_arbiter.clients.cli.main import run_main
from vram_arbiter.clients.net.diagnose import obstacle
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.errors import CODES
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE, RUNTIME_VARIABLE

pytestmark = pytest.mark.e2e
EVERY_ACTION = (
    ("evict", "x", "-r", "why"), ("pin", "x", "-r", "why"), ("unpin", "x"),
    ("release-dead", "x", "-r", "why"),
    ("drain", "-r", "why"), ("resume",),
)  # fmt: skip
STRANGER = 65534


def one_line(done: Finished) -> str:
    """What was said, if it is an error as errors are: one line on stderr, `vramctl: what is wrong
    (what to do)`."""
    assert done.stdout == ""
    (line,) = done.stderr.splitlines()
    assert line.startswith("vramctl: ")
    assert line.endswith(")"), f"no hint: {line}"
    return line


def typed(done: Finished) -> str:
    """The code of the error that `--json` printed."""
    error = json.loads(done.stdout)["error"]
    assert set(error) == {"code", "message", "hint", "details"}
    assert error["code"] in CODES
    assert error["hint"]
    return str(error["code"])


@pytest.mark.parametrize(
    ("command", "told"),
    [
        *((command, "usage: vramctl") for command in (
            ("evict", "", "-r", "why"), ("evict", "x", "-r", ""), ("evict", "x" * 129, "-r", "why"),
            ("pin", "x", "-r", "  "), ("release-dead", "x", "-r", "two\nlines"),
            ("unpin", "x\x1b[2J"), ("unpin", "x", "-r", "y" * 513), ("drain", "-r", " "),
            ("resume", "-r", "a\tb"), ("why", ""), ("why", "x\ny"), ("why",),
            ("status", "--bogus"), ("status", "extra"), ("history", "-n", "0"),
            ("history", "--since", "yesterday"), ("run", "true"), ("run", "--vram", "5XB", "true"),
            ("run", "--vram", "0GiB", "true"), ("run", "--vram", "9" * 400 + "GiB", "true"),
            ("run", "--vram", "1GiB", "--on-revoke", "kill", "true"),
        )),
        (("stauts",), "did you mean status?"),
        (("history", "--kind", "grant"), "did you mean granted?"),
        (("run", "--vram", "5", "true"), "such as 5GiB or 450MiB, got '5'"),
        (("status", "--endpoint", "tcp://127.0.0.1:1"), "tcp:// is refused"),
    ],
)  # fmt: skip
def test_2_what_is_mistyped_is_told_before_anybody_is_asked(
    command: tuple[str, ...],
    told: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """There is no daemon: who asked one would end with 3. Regression: `--kind bogus` ended with 1,
    `tcp://` with 3, and a size of 400 digits in an OverflowError; `--vram 5` was five bytes."""
    monkeypatch.delenv(ENDPOINT_VARIABLE, raising=False)
    monkeypatch.setenv(RUNTIME_VARIABLE, str(tmp_path))
    try:
        code = run_main([*command])
    except SystemExit as end:
        code = int(end.code or 0)
    said = capsys.readouterr()
    assert (code, said.out) == (2, "")
    assert told in said.err


@pytest.mark.parametrize("command", [("bogus",), ("replay",), ("replay", "x", "--policy", "best")])
def test_2_is_the_code_of_the_program(command: tuple[str, ...]) -> None:
    done = vramctl(*command, environ=dict(os.environ))
    assert (done.returncode, done.stdout) == (2, "")
    assert "usage: vramctl" in done.stderr


def test_1_for_what_cannot_be_done(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """Regression: empty reasons were journaled."""
    environ = arbiter_daemon.environ
    det = client.acquire(spec("det", 1))
    det.ready()
    for name in ("twin", "twin"):
        client.acquire(spec(name, 1)).ready()
    ended = client.acquire(spec("gone", 1))
    ended.release()
    assert "no lease or consumer 'x'" in one_line(
        vramctl("evict", "x", "-r", "why", environ=environ)
    )
    assert "name one of them: L" in one_line(vramctl("pin", "twin", "-r", "why", environ=environ))
    assert "nothing to undo" in one_line(vramctl("unpin", "det", environ=environ))
    assert "it is not dead (evict it instead)" in one_line(
        vramctl("release-dead", "det", "-r", "why", environ=environ)
    )
    assert "vramctl history" in one_line(
        vramctl("evict", ended.lease_id, "-r", "why", environ=environ)
    )
    codes = {
        command: (done.returncode, typed(done))
        for command in (("evict", "x", "-r", "y"), ("pin", "twin", "-r", "y"), ("unpin", "det"))
        for done in (vramctl(*command, "--json", environ=environ),)
    }  # fmt: skip
    assert list(codes.values()) == [(1, "unknown_lease"), (1, "bad_request"), (1, "bad_state")]
    nobody = vramctl("why", "nobody", environ=environ)
    assert (nobody.returncode, nobody.stdout.count("\n")) == (1, 1)
    assert "`vramctl history -c nobody`" in nobody.stdout
    assert vramctl("why", det.lease_id, environ=environ).stdout.startswith("det: "), (
        "a lease is named by its id as well"
    )
    empty = vramctl("history", "-c", "nobody", "-c", "det", environ=environ)
    assert empty.returncode == 0, "nothing is an answer"
    assert empty.stdout.count("no such event of 'nobody'") == 1
    assert "no such event of 'det'" not in empty.stdout


@pytest.mark.skipif(os.getuid() != 0, reason="needs root to become somebody else")
def test_who_is_no_operator_may_look_and_is_told_who_may_act(
    client: Client, arbiter_daemon: ArbiterProcess, spec: Spec
) -> None:
    """Regression: `vramctl` waited 3 s and reported a missing arbiter to users without permission
    on the socket."""
    environ = arbiter_daemon.environ
    lease = client.acquire(spec("det", 1))
    lease.ready()
    sock = arbiter_daemon.runtime / "arbiter.sock"
    arbiter_daemon.runtime.chmod(0o755)
    sock.chmod(0o666)
    for action in EVERY_ACTION:
        refused = vramctl(*action, user=STRANGER, environ=environ)
        assert (refused.returncode, "operators_group" in one_line(refused)) == (1, True), action
    assert (
        typed(vramctl("evict", "det", "-r", "why", "--json", user=STRANGER, environ=environ))
        == "not_permitted"
    )
    assert vramctl("why", "det", user=STRANGER, environ=environ).returncode == 0
    assert lease.state == "held"
    sock.chmod(0o660)
    os.chown(sock, -1, 0)
    for command in (
        ("status",),
        ("evict", "det", "-r", "why"),
        ("history", "--follow"),
        ("run", "--vram", "1GiB", "true"),
    ):
        shut_out = vramctl(*command, user=STRANGER, environ=environ)
        assert (shut_out.returncode, "may not be used by uid 65534" in one_line(shut_out)) == (
            3,
            True,
        ), command
    assert "join the group root" in shut_out.stderr
    arbiter_daemon.runtime.chmod(0o700)
    assert "its folder is closed to you" in one_line(
        vramctl("status", user=STRANGER, environ=environ)
    )
    os.chown(arbiter_daemon.runtime, -1, grp.getgrnam("daemon").gr_gid)
    arbiter_daemon.runtime.chmod(0o750)  # as the daemon makes it for a group
    assert "join the group daemon" in one_line(vramctl("status", user=STRANGER, environ=environ))


def test_3_for_a_daemon_that_is_dead_or_stopped(arbiter_daemon: ArbiterProcess) -> None:
    """Regression: libzmq reconnects silently; `vramctl` waited 3 s and reported a missing arbiter
    after a kill."""
    environ = arbiter_daemon.environ
    os.kill(arbiter_daemon.pid, signal.SIGSTOP)
    try:
        assert "look at the arbiter's log" in one_line(
            vramctl("drain", "-r", "why", environ=environ)
        )
    finally:
        os.kill(arbiter_daemon.pid, signal.SIGCONT)
    status = json.loads(vramctl("status", "--json", environ=environ).stdout)
    assert status["drained"] == "", "what ended with 3 was not done afterwards"
    arbiter_daemon.kill()
    others = (("history",), ("why", "x"), ("history", "-f"))
    for action, dead in vramctl_at_once((*EVERY_ACTION, *others), environ=environ):
        assert (dead.returncode, "it was killed, its socket is left over" in one_line(dead)) == (
            3,
            True,
        ), action
    as_json = (("resume", "--json"), ("history", "-f", "--json"))
    for action, dead in vramctl_at_once(as_json, environ=environ):
        assert typed(dead) == "arbiter_unreachable", action
    (arbiter_daemon.runtime / "arbiter.sock").unlink()
    assert "the socket does not exist" in one_line(vramctl("resume", environ=environ))
    (arbiter_daemon.runtime / "arbiter.sock").write_text("")
    assert "is not a socket" in one_line(vramctl("resume", environ=environ))
    assert "Linux allows 107" in one_line(
        vramctl("resume", "--endpoint", f"ipc:///{'x' * 200}", environ=environ)
    )
    assert "'garbage' is not an endpoint" in one_line(
        vramctl("resume", "--endpoint", "garbage", environ=environ)
    )


def test_a_look_at_the_socket_disturbs_nobody(
    client: Client, arbiter_daemon: ArbiterProcess
) -> None:
    """`obstacle` connects and says nothing."""
    for _ in range(300):
        assert obstacle(arbiter_daemon.endpoint) is None
    assert client.status().clients == 1


def test_a_log_is_replayed_or_refused(arbiter_daemon: ArbiterProcess, tmp_path: Path) -> None:
    """What may be wrong with one is the reader's: tests/arbiter/eventlog/test_replay.py."""
    environ = arbiter_daemon.environ
    assert arbiter_daemon.stop() == 0
    (whole,) = (arbiter_daemon.state / "record").glob("*.jsonl")
    done = vramctl("replay", str(whole), environ=environ)
    assert (done.returncode, " identical (" in done.stdout) == (0, True), done.stderr
    nothing = str(tmp_path / "nothing")
    assert "no event log here" in one_line(vramctl("replay", nothing, environ=environ))
    as_json = vramctl("replay", nothing, "--json", environ=environ)
    assert json.loads(as_json.stdout)["error"]["hint"]
