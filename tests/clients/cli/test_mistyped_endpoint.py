"""An endpoint in a folder that is not there: every program says so, and none makes the folder."""

import json
import os
import subprocess
import sys
from pathlib import Path

from tests.support.prepared import start
from tests.support.process import vramctl
from tests.support.waiting import PATIENCE_S

COMMANDS = (
    ("vramctl", "status"),
    ("vramctl", "evict", "x", "-r", "y"),
    ("vramctl", "history", "-f"),
    ("vramctl", "run", "--vram", "1GiB", "true"),
    ("vram-arbiter", "--gpu", "fake:8GiB"),
)
ESTOP = (sys.executable, "-m", "vram_arbiter.runner", "estop")
"""Not forked: the base install, where this runs too, lacks what a runner's server imports."""


def test_a_mistyped_endpoint_makes_no_folders(short_folder: Path) -> None:
    """A daemon on a mistyped endpoint served there, alone, in folders that it had made on
    the way."""
    runtime = short_folder / "runtime"
    runtime.mkdir()
    endpoint = f"ipc://{short_folder}/runn/vram-arbiter/arbiter.sock"
    environ = os.environ | {
        "VRAM_ARBITER_RUNTIME": str(runtime), "VRAM_ARBITER_ENDPOINT": endpoint
    }  # fmt: skip
    estop = subprocess.Popen(ESTOP, env=environ, stderr=subprocess.PIPE, text=True)
    programs = [*(start(program, words, environ) for program, *words in COMMANDS), estop]
    for command, program in zip((*COMMANDS, ESTOP), programs, strict=True):
        # each waits for the arbiter for a while, side by side
        _, said = program.communicate(PATIENCE_S)
        assert program.returncode in (1, 2, 3), command
        (line,) = said.splitlines()
        assert "/runn" in line, command
    assert [*short_folder.iterdir()] == [runtime]
    assert [*runtime.iterdir()] == []


def test_an_unusable_endpoint_is_json_where_json_was_asked_for() -> None:
    """A script that parses `--json` got a bare line on stderr for errors of configuration."""
    words = ("history", "--follow", "--json", "--endpoint", "tcp://192.0.2.1:5")
    done = vramctl(*words, environ=os.environ)
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["code"] == "config_error"
    assert done.stderr == ""
