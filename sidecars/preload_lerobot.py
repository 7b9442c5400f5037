"""lerobot's policies for the server of imports, without diffusers and PEFT.

lerobot imports the code of all its policies, and with it diffusers and PEFT where these are
installed: 4 s of a core, and bitsandbytes, whose import initializes CUDA before the fork. A family
that needs one of them takes `preload_diffusers` or `preload_peft` instead.
"""

from vram_arbiter.sidecars.lerobot_packages import import_policies

import_policies(without=("diffusers", "peft"))
