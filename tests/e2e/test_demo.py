"""The main job, whole: `vramctl demo` with six real processes, with and without the arbiter."""

import contextlib
import importlib.util
import json
import os
import pty
import select
import shlex
import subprocess
import sys
import termios
import urllib.error
import urllib.request
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.support.prepared import warm
from tests.support.waiting import until
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.runtime.ports import free_port

pytestmark = [pytest.mark.e2e, pytest.mark.heavy, pytest.mark.timeout(720)]


def run_demo(
    out: Path,
    *arguments: str,
    told: Callable[[str], None] = lambda line: None,
    program: str = "vram_arbiter.clients",
) -> tuple[int, dict[str, Any]]:
    for module in ("torch", "lerobot", "mujoco"):
        pytest.importorskip(module, reason="needs the full install")
    command = [sys.executable, "-m", program, "demo", "--out", str(out), *arguments]
    printed = []
    with subprocess.Popen(
        command,
        stdout=subprocess.PIPE,
        stderr=subprocess.STDOUT,
        text=True,
        env=os.environ | {"MUJOCO_GL": "egl", "PYTHONUNBUFFERED": "1"},
    ) as process:
        assert process.stdout is not None
        for line in process.stdout:
            printed.append(line)
            told(line)
    assert (out / "summary.json").exists(), "".join(printed)
    return process.returncode, json.loads((out / "summary.json").read_text())


def screen_of(command: list[str], until: bytes) -> bytes:
    """What a program draws on a terminal of 80 by 24 until a text is there; `q` ends it then."""
    master, terminal = pty.openpty()
    termios.tcsetwinsize(terminal, (24, 80))
    process = subprocess.Popen(
        command, env=os.environ | {"TERM": "xterm-256color"},
        stdin=terminal, stdout=terminal, stderr=terminal,
    )  # fmt: skip
    os.close(terminal)
    shown, asked = b"", False
    try:
        with contextlib.suppress(OSError):  # its end closes the terminal
            while select.select([master], [], [], 120.0)[0]:
                shown += os.read(master, 65_536)
                if until in shown and not asked:
                    asked = True
                    os.write(master, b"q")
        assert process.wait(60.0) == 0, shown
    finally:
        process.kill()
        process.wait()
        os.close(master)
    return shown


def page_at(url: str) -> bytes:
    """Return what is served there; nothing while the page's program is still starting."""
    try:
        with urllib.request.urlopen(url, timeout=60.0) as answer:
            return bytes(answer.read())
    except urllib.error.URLError:
        return b""


class Watched:
    """What a person with the demo's printed lines sees meanwhile."""

    def __init__(self) -> None:
        self.page = self.screen = b""
        self.printed = ""

    def line(self, printed: str) -> None:
        """Do what a line of the demo says: open the page, type the command."""
        self.printed += printed
        if printed.startswith("status page: "):
            self.page = until(lambda: page_at(printed.split()[-1]))
        elif printed.startswith("live in another terminal: "):
            self.screen = screen_of(shlex.split(printed.partition(": ")[2]), b"GPU 0")


def test_find_navigate_grab_fits_in_eight_gib(tmp_path: Path) -> None:
    """With the page and `vramctl top` over it, by the lines that the demo prints. Its programs are
    forked; in the night they start as they do for a person."""
    warm("vram-sidecar")
    warm("vram-runner")
    port = free_port()
    watched = Watched()
    options = ("--seed", "0", "--http", str(port))
    forked = "tests.support.forked_demo"
    code, summary = run_demo(tmp_path / "on", *options, told=watched.line, program=forked)
    assert b"<title>" in watched.page
    assert b"arbiter serving" in watched.screen
    assert summary["completed"], summary
    assert code == 0
    assert summary["oom_events"] == 0
    assert summary["switches"] == summary["switches_verified"] >= 1
    assert summary["peak_bytes"] <= summary["capacity_bytes"] == 8 * GIB
    grab = next(load for load in summary["loads"] if load["consumer"] == "grab")
    assert grab["evicted"] == ["detector"], "the detector fits beside neither of the others"
    vlm = [load for load in summary["loads"] if load["consumer"] == "scene-vlm"][-1]
    assert vlm["evicted"] == [], "scene VLM and policy fit together and must not evict each other"
    back = summary["detector_back"]
    assert summary["detector_resident"]
    assert back["verdict"] == "verified"
    assert back["reason"] == "back from standby: there is room and nothing waits"
    assert f"the detector is back by itself, {back['after_s']} s after" in watched.printed
    assert (tmp_path / "on" / "timeline.png").read_bytes().startswith(b"\x89PNG")
    assert b"ftyp" in (tmp_path / "on" / "episode.mp4").read_bytes()[:64]


@pytest.mark.nightly  # it starts all programs once more; they have tests of their own
def test_without_the_arbiter_the_same_loop_runs_out_of_memory(tmp_path: Path) -> None:
    code, summary = run_demo(tmp_path / "off", "--seed", "0", "--arbiter", "off")
    assert not summary["completed"]
    assert summary["oom_events"] >= 1
    assert code == 0, "an out-of-memory is what this run is to show"


@pytest.mark.nightly
@pytest.mark.parametrize("arbiter", ["on", "off"])
def test_a_panda_finds_navigates_and_grabs(tmp_path: Path, arbiter: str) -> None:
    """The detector's 5.3 GB and the policy's 4.3 GB do not fit beside each other."""
    if importlib.util.find_spec("robosuite") is None:
        pytest.skip("needs robosuite's files: .ci/setup full")
    options = ("--robot", "panda-mobile", "--seed", "2", "--arbiter", arbiter)
    code, summary = run_demo(tmp_path, *options)
    assert code == 0
    assert summary["completed"] == (arbiter == "on"), summary
    assert bool(summary["oom_events"]) == (arbiter == "off")
