"""`vramctl replay`: needs the engine, which clients never import, so it is a program of the arbiter's that is started here."""

import signal
import subprocess
import sys
from collections.abc import Sequence

PROGRAM = "arbiter.replay"


def run(arguments: Sequence[str]) -> int:
    """Start `python -m arbiter.replay ARGUMENTS` on this terminal and return its exit code (128+n if signal n ended it)."""
    before = signal.signal(
        signal.SIGINT, signal.SIG_IGN
    )  # Ctrl-C is the program's; it is waited for in any case
    try:
        code = subprocess.run([sys.executable, "-m", PROGRAM, *arguments], check=False).returncode
    finally:
        signal.signal(signal.SIGINT, before)
    return code if code >= 0 else 128 - code
