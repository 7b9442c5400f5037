"""The engine's own state, for tests of one room's functions and tests that break it by hand.

Everything else looks through `Arbiter.inspect()`.
"""

from typing import Any, cast

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.model.state import Core


def state_of(arbiter: Arbiter) -> Core:
    """The state itself: a room's function takes it, and a test may spoil it."""
    return cast(Core, cast(Any, vars(arbiter))["_core"])
