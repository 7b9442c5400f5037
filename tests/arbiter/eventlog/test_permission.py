"""Replay of a log that its user may not read.

Regression: `Path.is_dir` raises without permission, and `vramctl replay` ended with a traceback.
"""

import subprocess
import sys
from pathlib import Path
from tempfile import TemporaryDirectory

from tests.support.paths import ROOT

STRANGER = """
import os, sys
from pathlib import Path
from vram_arbiter.arbiter.eventlog.replay import load
from vram_arbiter.schemas.errors import VramError
if os.getuid() == 0:  # root may read everything
    os.setgroups([]); os.setresgid(65534, 65534, 65534); os.setresuid(65534, 65534, 65534)
try:
    load(Path(sys.argv[1]))
except VramError as error:
    print(error)
"""


def test_a_folder_without_permission_is_the_operators_error() -> None:
    """`vramctl replay /var/lib/vram-arbiter` as an ordinary user ended with a traceback."""
    with TemporaryDirectory() as parent:  # pytest's own folder is closed to strangers
        Path(parent).chmod(0o711)
        state = Path(parent) / "state"
        record = state / "record"
        record.mkdir(parents=True)
        for closed in (state, record):
            closed.chmod(0o000)
            done = subprocess.run(
                [sys.executable, "-c", STRANGER, str(state)],
                cwd=ROOT,
                capture_output=True,
                text=True,
                check=False,
            )
            closed.chmod(0o711)
            assert done.stderr == ""
            assert "cannot be read: Permission denied" in done.stdout
            assert "use that user, or root" in done.stdout
