"""`vram-gateway demo`, as a user runs it."""

import os
import re
import subprocess
import sys
import tempfile

import pytest

SERVERS = ("chat", "code")


@pytest.mark.e2e
@pytest.mark.nightly
def test_two_servers_take_turns_and_answer_everyone() -> None:
    elsewhere = {"VRAM_ARBITER_ENDPOINT": "ipc:///nowhere/arbiter.sock"}  # not the demo's affair
    done = subprocess.run(
        [sys.executable, "-m", "vram_arbiter.sidecars.gateway", "demo", "--no-browser"],
        env=os.environ | elsewhere | {"TMPDIR": tempfile.gettempdir()},
        capture_output=True,
        text=True,
        timeout=120,
    )
    assert done.returncode == 0, done.stdout + done.stderr
    told, drawn, sums = done.stdout.strip().split("\n\n")
    assert "code took over from chat" in told
    for name in SERVERS:
        assert re.search(rf"^{name} .*█", drawn, re.MULTILINE), drawn
        assert re.search(rf"^{name}: requests [1-9]\d*, failed 0, switches", sums, re.MULTILINE)
