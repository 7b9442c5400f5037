"""A scripted policy of the tests: notes each seed that it begins, and gives up in its second step.
Some seeds end or stop the process that plays them, or play on.

Environment: NOTES, the file; FATES, JSON: by seed a signal (0: play on) and in how many of its
episodes.
"""

import json
import os
from pathlib import Path
from typing import Any


def make(env: Any, seed: int) -> Any:
    notes = Path(os.environ["NOTES"])
    with notes.open("a", encoding="utf-8") as file:
        file.write(f"{seed}\n")
    number, times = json.loads(os.environ.get("FATES", "{}")).get(str(seed), (None, 0))
    fated = notes.read_text(encoding="utf-8").splitlines().count(str(seed)) <= times
    if fated:
        os.kill(os.getpid(), number)
    left = 2

    def act(world: Any) -> Any:
        nonlocal left
        left -= 1
        return dict(env.sent()) if left or fated else None

    return act
