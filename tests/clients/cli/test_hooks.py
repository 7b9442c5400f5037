"""`vramctl hooks` as a program, beside a real arbiter that is killed and started again."""

import json
import os
import signal
from collections.abc import Callable
from pathlib import Path

import pytest

from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess, vramctl
from tests.support.waiting import until
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.wire.spec import LeaseSpec

Spec = Callable[..., LeaseSpec]
PATIENCE_S = 60.0
RULES = """
hooks:
  - name: keep
    on: granted
    command: [sh, -c, 'cat >> {file}']
  - name: fails
    on: granted
    command: ['false']
  - name: out
    on: evicted
    command: [sh, -c, 'cat >> {file}.out']
"""


def delivered(file: Path) -> list[int]:
    return [json.loads(line)["seq"] for line in file.read_text().splitlines()]


def test_check_and_test_say_what_would_run(tmp_path: Path) -> None:
    config, file = tmp_path / "hooks.yaml", tmp_path / "events"
    config.write_text(RULES.format(file=file))
    config.chmod(0o600)
    environ = {**os.environ, "VRAM_ARBITER_RUNTIME": str(tmp_path)}
    words = ("hooks", "run", "--check", "--config", str(config))
    checked = vramctl(*words, environ=environ)
    assert checked.stderr == ""
    assert (checked.returncode, checked.stdout.splitlines()[1]) == (
        0, "fails: on granted runs 'false', at most 10 s",
    )  # fmt: skip
    assert not file.exists(), "nothing was run"
    fired = vramctl("hooks", "test", "keep", "--config", str(config), environ=environ)
    assert (fired.returncode, delivered(file)) == (0, [0])
    failed = vramctl("hooks", "test", "fails", "--config", str(config), environ=environ)
    assert (failed.returncode, "false failed with exit code 1" in failed.stderr) == (1, True)
    config.write_text("hooks:\n  - name: a\n    on: granted\n    command: [/nowhere]\n")
    wrong = vramctl(*words, environ=environ)
    config.chmod(0o666)
    open_file = vramctl(*words, environ=environ)
    assert (open_file.returncode, "may be written by other users" in open_file.stderr) == (2, True)
    assert (wrong.returncode, "/nowhere is not a program" in wrong.stderr) == (2, True)
    config.chmod(0o600)
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o777)
    config.write_text(f"hooks:\n  - name: a\n    on: granted\n    command: [{program}]\n")
    planted = vramctl(*words, environ=environ)
    assert f"{program} may be written by other users" in planted.stderr
    assert planted.returncode == 2


@pytest.mark.e2e
def test_every_grant_is_delivered_once_across_restarts(
    arbiter_daemon: ArbiterProcess, spec: Spec, tmp_path: Path
) -> None:
    config, file, log = tmp_path / "hooks.yaml", tmp_path / "events", tmp_path / "log"
    config.write_text(RULES.format(file=file))
    config.chmod(0o600)
    file.touch()
    words = ["hooks", "run", "--config", str(config), "--state", str(tmp_path / "own/hooks.json")]

    def run() -> Forked:
        with log.open("wb") as out:
            return start("vramctl", words, arbiter_daemon.environ, out.fileno(), out.fileno())

    def grant(count: int) -> None:
        with Client("t", endpoint=arbiter_daemon.endpoint) as client:
            for _ in range(count):
                with client.lease(spec("a", 1)) as lease:
                    lease.ready()

    def grown_to(count: int) -> bool:
        return len(delivered(file)) >= count

    grant(1)  # before the first start: not delivered
    hooks = run()
    try:
        until(lambda: "delivers events" in log.read_text(), PATIENCE_S)
        with Client("t", endpoint=arbiter_daemon.endpoint) as client:
            client.acquire(spec("leaves", 5)).ready()
            with client.lease(spec("comes", 5)) as lease:
                lease.ready()
        until(lambda: grown_to(2), PATIENCE_S)
        arbiter_daemon.kill()
        arbiter_daemon.start()
        grant(2)
        until(lambda: grown_to(4), PATIENCE_S)
        hooks.send_signal(signal.SIGTERM)
        assert hooks.wait(PATIENCE_S) == 0, log.read_text()
        assert "keep: 4 done, 0 failed, 0 dropped" in log.read_text()
        evicted = json.loads(Path(f"{file}.out").read_text())
        assert (evicted["kind"], evicted["consumer"]) == ("unloading", "leaves")
        assert "fails: 0 done, 4 failed, 0 dropped" in log.read_text()
        grant(1)  # meanwhile
        arbiter_daemon.stop()
        hooks = run()
        until(lambda: "waiting for an arbiter" in log.read_text(), PATIENCE_S)
        arbiter_daemon.start()
        grant(1)
        until(lambda: grown_to(6), PATIENCE_S)
    finally:
        hooks.send_signal(signal.SIGTERM)
        assert hooks.wait(PATIENCE_S) == 0
    found = delivered(file)
    assert found == sorted(set(found)), "in order, none twice"
    told = vramctl("history", "--kind", "granted", "--json", environ=arbiter_daemon.environ)
    kept = [event["seq"] for event in json.loads(told.stdout)["events"]]
    assert set(kept[1:]) <= set(found)
    assert len(found) == 6
