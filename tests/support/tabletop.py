"""The simulated tabletop: its names, the scripted grab played to its end, and pictures of it."""

import io

from vram_arbiter.runner.sim.config import COLOURS, SHAPES
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import GrabExpert

NAMES = [f"{color} {shape}" for color in COLOURS for shape in SHAPES]
"""All names of objects that a scene can hold."""


def run_expert(env: SimEnv, expert: GrabExpert) -> bool:
    """Let the expert finish. Returns whether anything is held at the end."""
    for _ in range(150):
        env.step(expert.act())
        if expert.done:
            break
    for _ in range(6):
        env.step(expert.act())
    return env.held_object() is not None


def photo(env: SimEnv, camera: str) -> bytes:
    """Return a camera's picture as PNG."""
    from PIL import Image

    stream = io.BytesIO()
    Image.fromarray(env.render(camera)).save(stream, "PNG")
    return stream.getvalue()
