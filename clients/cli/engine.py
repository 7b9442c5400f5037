"""`vramctl replay` and `simulate`: they need the engine, which clients never import, so it is a program of the arbiter's that is started here."""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.clients.configs import configs_folder

PROGRAM = "vram_arbiter.arbiter.lab"


def run(arguments: Sequence[str]) -> int:
    """Start `python -m vram_arbiter.arbiter.lab ARGUMENTS` on this terminal and return its exit code (128+n if signal n ended it)."""
    # Ctrl-C is the program's; it is waited for in any case
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        code = subprocess.run(
            [sys.executable, "-m", PROGRAM, *arguments],
            check=False,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ).returncode
    finally:
        signal.signal(signal.SIGINT, before)
    return code if code >= 0 else 128 - code


def with_scenario(arguments: Sequence[str]) -> list[str]:
    """A word that is no file but names a shipped scenario becomes its path."""
    folder = configs_folder(os.environ) / "scenarios"
    shipped = {path.stem: str(path) for path in folder.glob("*.yaml")}
    return [
        shipped[word] if word in shipped and not Path(word).exists() else word for word in arguments
    ]
