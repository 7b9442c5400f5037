"""A scripted policy of the tests: holds the arm; with a seed of 13 it has a bug, with one of 14 it
gives up.
"""

from typing import Any


def make(env: Any, seed: int) -> Any:
    left = 3

    def act(world: Any) -> Any:
        nonlocal left
        left -= 1
        if seed == 13:
            raise IndexError("beyond the table")
        return None if seed == 14 and left < 2 else dict(env.sent())

    return act
