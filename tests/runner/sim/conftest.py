"""MuJoCo reads MUJOCO_GL when it is first imported: say how to render before any test module imports it."""

import os

os.environ.setdefault("MUJOCO_GL", "egl")
