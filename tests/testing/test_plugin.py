"""The pytest plugin, in fresh runs of pytest with workers: what it leaves, and what a report
shows. They load this plugin and xdist alone."""

import os
import shutil
import subprocess
import sys
from contextlib import closing
from pathlib import Path

import pytest

from tests.support.paths import ROOT
from tests.support.processes import alive
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.testing.daemon import ArbiterProcess

PLUGIN = "vram_arbiter.testing.plugin"
SUITE = """
import os

import pytest
from vram_arbiter import Client
from vram_arbiter.testing.stand_in import hold

def note(*pids):
    with open(os.environ["PIDS"], "a") as file:
        print(*pids, file=file)

@pytest.mark.gpu_budget("8 bananas")
def test_wrong_size(arbiter):
    pass

@pytest.mark.gpu_budget("8GiB", delay="1s")
def test_wrong_key(arbiter):
    pass

@pytest.mark.gpu_budget(lag="soon")
def test_wrong_lag(arbiter):
    pass

@pytest.mark.gpu_budget("2GiB", lag="250ms", config="gpu: {reserve_bytes: 1GiB}")
def test_a_budget(arbiter, fake_gpu):
    note(arbiter.pid)
    assert fake_gpu.free_bytes == 2 << 30
    assert '"release_lag_s": 0.25' in (fake_gpu.folder / "gpu.json").read_text()
    with Client("test", endpoint=arbiter.endpoint) as client:
        assert client.status().gpus[0].reserve_bytes == 1 << 30

def test_failing(arbiter, consumer, timeline):
    detector = consumer("detector", hold, "detector", "5GiB")
    note(arbiter.pid, detector.pid)
    detector.reached("held")
    timeline.evicted_once("detector")

def test_failing_after_the_end(arbiter, consumer):
    consumer("short", ["true"]).close()
    arbiter.close()
    assert False
"""


def pytest_at(folder: Path, **environ: str) -> subprocess.CompletedProcess[str]:
    """Run the tests in a folder as its own project, with two workers; their temporary files lie in
    the folder `t` beside it."""
    temporary = folder.with_name("t")
    temporary.mkdir()
    options = ["-p", PLUGIN, "-p", "xdist", "-n", "2", "-p", "no:cacheprovider", "-rA"]
    environ |= {"PYTEST_DISABLE_PLUGIN_AUTOLOAD": "1", "TMPDIR": str(temporary)}
    return subprocess.run(
        [sys.executable, "-m", "pytest", *options, "--rootdir", str(folder)],
        cwd=folder, env=os.environ | environ, capture_output=True, text=True,
        timeout=2 * PATIENCE_S, check=False,
    )  # fmt: skip


def test_pytest_starts_without_the_kit(tmp_path: Path) -> None:
    """Every run of pytest in an environment with the package imports the plugin."""
    code = f"""
import sys, pytest
before = set(sys.modules)
import {PLUGIN}
print(*sorted(set(sys.modules) - before))
"""
    said = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert said.stdout.split() == ["vram_arbiter", "vram_arbiter.testing", PLUGIN]


@pytest.mark.e2e
def test_reports_and_leftovers(tmp_path: Path) -> None:
    suite, pids = tmp_path / "suite", tmp_path / "pids"
    suite.mkdir()
    (suite / "test_it.py").write_text(SUITE)
    (suite / "pytest.ini").write_text("[pytest]\naddopts = --strict-markers\n")
    done = pytest_at(suite, PIDS=str(pids))
    said = done.stdout
    assert "2 failed, 1 passed, 3 errors" in said, said + done.stderr
    for problem in (
        "@pytest.mark.gpu_budget: not a size: '8 bananas'; write bytes or 8GiB",
        "@pytest.mark.gpu_budget: gpu_budget() got an unexpected keyword argument 'delay'",
        "@pytest.mark.gpu_budget: expected a time such as 500ms or 1.5s, got 'soon'",
        "AssertionError: detector was evicted 0 times, not once",
        "- timeline of the arbiter -",
        "alloc 5 GiB by detector",
        "- log of the arbiter -",
        "- output of detector -",
        "no history: ",
        "cannot be read: ",
    ):
        assert problem in said
    assert list((tmp_path / "t").glob("va*")) == []
    started = pids.read_text().split()
    assert len(started) == 3
    assert [pid for pid in started if Path(f"/proc/{pid}").exists()] == []


@pytest.mark.e2e
def test_the_example_project_passes(tmp_path: Path) -> None:
    project = shutil.copytree(ROOT / "examples/testing", tmp_path / "project")
    done = pytest_at(project)
    assert (done.returncode, done.stderr) == (0, ""), done.stdout + done.stderr
    assert "3 passed" in done.stdout
    assert list((tmp_path / "t").glob("va*")) == []


KILLED = """
import sys, threading
from vram_arbiter.testing.daemon import ArbiterProcess

arbiter = ArbiterProcess()
starting = threading.Thread(target=arbiter.start)
starting.start()
starting.join()
print(arbiter.pid, flush=True)
sys.stdin.read()
"""


def test_a_daemon_keeps_its_bytecode(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In an environment without, each daemon compiled all that it imports: a third of its start."""
    monkeypatch.setenv("PYTHONDONTWRITEBYTECODE", "1")
    with closing(ArbiterProcess()) as arbiter:
        arbiter.start({"PYTHONPYCACHEPREFIX": str(tmp_path)})
    assert list(tmp_path.rglob("daemon.*.pyc"))


def test_a_killed_test_takes_its_daemon_along(short_folder: Path) -> None:
    """It ran on, with its folder; the end of the thread that started it does not end it."""
    environ = os.environ | {"TMPDIR": str(short_folder)}
    command = [sys.executable, "-c", KILLED]
    with subprocess.Popen(
        command, env=environ, stdin=subprocess.PIPE, stdout=subprocess.PIPE
    ) as test:
        assert test.stdout is not None
        daemon = int(test.stdout.readline())
        assert alive(daemon)
        test.kill()
    until(lambda: not alive(daemon))
