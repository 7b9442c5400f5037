"""lerobot's policies with diffusers, for the server of imports.

bitsandbytes comes first, which diffusers imports where it is installed: alone it initializes CUDA.
"""

from importlib.util import find_spec

from vram_arbiter.sidecars.quantization import load_bitsandbytes

if find_spec("bitsandbytes") is not None:
    load_bitsandbytes()

import lerobot.policies.factory  # noqa: F401  reason: for every model process
