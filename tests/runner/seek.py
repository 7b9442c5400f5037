"""A scripted policy of the tests: drives the point to its mark; with a seed of 13 it has a bug,
with one of 14 it gives up.
"""

from typing import Any


def make(env: Any, seed: int) -> Any:
    left = 3

    def act(world: Any) -> Any:
        nonlocal left
        left -= 1
        if seed == 13:
            raise IndexError("beyond the mark")
        if seed == 14:
            return None if left < 2 else (0.99, 0.99)
        return env.observation["agent_pos"][2:] if left < 1 else (0.99, 0.99)

    return act
