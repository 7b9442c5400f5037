"""`vram-observer` as a program with hooks, beside a real arbiter that is killed and started
again."""

import json
import os
import signal
from pathlib import Path

import pytest

from tests.support.leases import Spec
from tests.support.observer import ObserverProcess, config_file
from tests.support.prepared import run
from tests.support.process import ArbiterProcess, Finished, vramctl
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.sync import Client

RULES = """
http: {{listen: null}}
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
    file = tmp_path / "events"
    config = config_file(tmp_path, RULES.format(file=file))
    environ = {**os.environ, "VRAM_ARBITER_RUNTIME": str(tmp_path)}

    def observer(*words: str) -> Finished:
        return run("vram-observer", [*words, "--config", str(config)], environ, PATIENCE_S)

    checked = observer("--check")
    assert checked.stderr == ""
    assert checked.returncode == 0
    assert checked.stdout.splitlines()[:3:2] == [
        "status page and /metrics: none",
        "fails: on granted runs 'false', at most 10 s",
    ]
    assert not file.exists(), "nothing was run"
    fired = observer("--test-hook", "keep")
    assert (fired.returncode, delivered(file)) == (0, [0])
    failed = observer("--test-hook", "fails")
    assert (failed.returncode, "false failed with exit code 1" in failed.stderr) == (1, True)
    assert observer("--test-hook", "keep", "--on", "denied").returncode == 2
    config.write_text("hooks:\n  - name: a\n    on: granted\n    command: [/nowhere]\n")
    wrong = observer("--check")
    config.chmod(0o666)
    open_file = observer("--check")
    assert (open_file.returncode, "may be written by other users" in open_file.stderr) == (2, True)
    assert (wrong.returncode, "/nowhere is not a program" in wrong.stderr) == (2, True)
    config.chmod(0o600)
    program = tmp_path / "program"
    program.write_text("#!/bin/sh\n")
    program.chmod(0o777)
    config.write_text(f"hooks:\n  - name: a\n    on: granted\n    command: [{program}]\n")
    planted = observer("--check")
    assert f"{program} may be written by other users" in planted.stderr
    assert planted.returncode == 2


@pytest.mark.e2e
def test_every_grant_is_delivered_once_across_restarts(
    arbiter_daemon: ArbiterProcess, spec: Spec, tmp_path: Path
) -> None:
    file = tmp_path / "events"
    file.touch()
    observer = ObserverProcess(arbiter_daemon, (), config=RULES.format(file=file))

    def grant(count: int) -> None:
        with Client("t", endpoint=arbiter_daemon.endpoint) as client:
            for _ in range(count):
                with client.lease(spec("a", 1)) as lease:
                    lease.ready()

    def grown_to(count: int) -> bool:
        return len(delivered(file)) >= count

    grant(1)  # before the first start: not delivered
    observer.start()
    try:
        with Client("t", endpoint=arbiter_daemon.endpoint) as client:
            client.acquire(spec("leaves", 5)).ready()
            with client.lease(spec("comes", 5)) as lease:
                lease.ready()
        until(lambda: grown_to(2), PATIENCE_S)
        arbiter_daemon.kill()
        arbiter_daemon.start()
        grant(2)
        until(lambda: grown_to(4), PATIENCE_S)
        # a stop would cut the last one short
        until(lambda: observer.log.count("false failed with exit code 1") == 4, PATIENCE_S)
        assert observer.stop() == 0, observer.log
        assert observer.log.count("keep: event") == 4
        evicted = json.loads(Path(f"{file}.out").read_text())
        assert (evicted["kind"], evicted["consumer"]) == ("unloading", "leaves")
        grant(1)  # meanwhile
        arbiter_daemon.stop()
        observer.spawn()
        until(lambda: "waiting for an arbiter" in observer.log, PATIENCE_S)
        arbiter_daemon.start()
        grant(1)
        until(lambda: grown_to(6), PATIENCE_S)
    finally:
        assert observer.stop(signal.SIGTERM) == 0
    found = delivered(file)
    assert found == sorted(set(found)), "in order, none twice"
    told = vramctl("history", "--kind", "granted", "--json", environ=arbiter_daemon.environ)
    kept = [event["seq"] for event in json.loads(told.stdout)["events"]]
    assert set(kept[1:]) <= set(found)
    assert len(found) == 6
