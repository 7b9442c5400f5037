"""An endpoint in a folder that is not there: every program says so, and none makes the folder."""

import json
import os
import subprocess
import sys
from pathlib import Path

ROOT = Path(__file__).parents[3]
GRAB = ROOT / "configs/rskills/so101-grab/rskill.yaml"


COMMANDS = (
    ["vram_arbiter.clients", "status", "--endpoint", "EP"],
    ["vram_arbiter.clients", "evict", "x", "-r", "y", "--endpoint", "EP"],
    ["vram_arbiter.clients", "run", "--vram", "1GiB", "--endpoint", "EP", "true"],
    ["vram_arbiter.clients", "history", "-f", "--endpoint", "EP"],
    ["vram_arbiter.arbiter", "--gpu", "fake:8GiB", "--endpoint", "EP"],
    ["vram_arbiter.runner", "estop", "--endpoint", "EP"],
)


def test_a_mistyped_endpoint_makes_no_folders(short_folder: Path) -> None:
    """A daemon on a mistyped endpoint served there, alone, in folders that it had made on
    the way."""
    endpoint = f"ipc://{short_folder}/runn/vram-arbiter/arbiter.sock"
    programs = [
        subprocess.Popen(
            [sys.executable, "-m", *(endpoint if word == "EP" else word for word in command)],
            cwd=ROOT,
            env={**os.environ, "VRAM_ARBITER_RUNTIME": str(short_folder)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.PIPE,
            text=True,
        )
        for command in COMMANDS
    ]
    for program in programs:  # each waits for the arbiter for a while, side by side
        said = program.communicate(timeout=60)[1]
        assert program.returncode in (1, 2, 3), program.args
        (line,) = said.splitlines()
        assert "/runn" in line, program.args
    assert list(short_folder.iterdir()) == []


def test_an_unusable_endpoint_is_json_where_json_was_asked_for() -> None:
    """A script that parses `--json` got a bare line on stderr for errors of configuration."""
    done = subprocess.run(
        [
            *(sys.executable, "-m", "vram_arbiter.clients", "history", "--follow", "--json"),
            *("--endpoint", "tcp://192.0.2.1:5"),
        ],
        cwd=ROOT,
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.returncode == 2
    assert json.loads(done.stdout)["error"]["code"] == "config_error"
    assert done.stderr == ""
