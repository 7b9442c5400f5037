"""lerobot's policies with diffusers and without PEFT, for the server of imports."""

from vram_arbiter.sidecars.lerobot_packages import import_policies

import_policies(without=("peft",))
