"""Fixtures of the simulator's tests.

MuJoCo reads MUJOCO_GL when it is first imported: it is set before any test module imports it.
"""

import os
from collections.abc import Iterator
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from vram_arbiter.runner.sim.env import SimEnv

os.environ.setdefault("MUJOCO_GL", "egl")


@pytest.fixture
def sim_env() -> "Iterator[SimEnv]":
    """The simulated arm on its table."""
    from vram_arbiter.runner.sim.env import SimEnv

    with SimEnv() as one:
        yield one
