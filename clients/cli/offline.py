"""`vramctl replay`: starts the arbiter's own program for event logs.

It needs the engine, which clients never import. That program parses the arguments, `--help` too.
"""

import signal
import subprocess
import sys
from collections.abc import Sequence

EVENT_LOG = "vram_arbiter.arbiter.offline"


def run(command: str, arguments: Sequence[str]) -> int:
    """Start the program on this terminal. Returns its exit code, 128+n if signal n ended it."""
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the program's
    try:
        code = subprocess.run(
            [sys.executable, "-m", EVENT_LOG, command, *arguments],
            check=False,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ).returncode
    finally:
        signal.signal(signal.SIGINT, before)
    return code if code >= 0 else 128 - code
