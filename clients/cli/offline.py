"""`vramctl replay` and `vramctl simulate`: start the arbiter's program for them.

They need the engine, which clients never import. That program parses the arguments, `--help` too.
"""

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path

from vram_arbiter.clients.configs import configs_folder

LABORATORY = "vram_arbiter.arbiter.lab"


def run(command: str, arguments: Sequence[str]) -> int:
    """Start the program on this terminal. Returns its exit code, 128+n if signal n ended it."""
    if command == "simulate":
        arguments = with_scenario(arguments)
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the program's
    try:
        code = subprocess.run(
            [sys.executable, "-m", LABORATORY, command, *arguments],
            check=False,
            preexec_fn=lambda: signal.signal(signal.SIGINT, signal.SIG_DFL),
        ).returncode
    finally:
        signal.signal(signal.SIGINT, before)
    return code if code >= 0 else 128 - code


def with_scenario(arguments: Sequence[str]) -> list[str]:
    """Replace the name of a shipped scenario by its path, unless a file has that name."""
    folder = configs_folder(os.environ) / "scenarios"
    shipped = {path.stem: str(path) for path in folder.glob("*.yaml")}
    return [
        shipped[word] if word in shipped and not Path(word).exists() else word for word in arguments
    ]
