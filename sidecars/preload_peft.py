"""lerobot's policies with PEFT and without diffusers, for the server of imports."""

from vram_arbiter.sidecars.lerobot_packages import import_policies

import_policies(without=("diffusers",))
