"""lerobot's policies with PEFT and without diffusers, for the server of imports.

bitsandbytes comes first, which PEFT imports where it is installed: alone it initializes CUDA.
"""

from importlib.util import find_spec

from vram_arbiter.sidecars.lerobot_packages import import_policies
from vram_arbiter.sidecars.quantization import load_bitsandbytes

if find_spec("bitsandbytes") is not None:
    load_bitsandbytes()

import_policies(without=("diffusers",))
