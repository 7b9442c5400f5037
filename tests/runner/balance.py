"""A scripted policy of the tests: pushes the cart to where the pole falls, for as many steps as
wanted.
"""

from typing import Any


def make(env: Any, seed: int) -> Any:
    def act(world: Any) -> int:
        angle, speed = env.observation[2], env.observation[3]
        return int(angle + 0.5 * speed > 0)

    return act
