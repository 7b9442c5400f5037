"""lerobot's policies for the server of imports, without diffusers.

lerobot imports the code of all its policies, and GR00T's imports diffusers where that is installed:
4 s of a core, and bitsandbytes with it, whose import initializes CUDA before the fork. A family
that needs diffusers takes `preload_diffusers` instead.
"""

from lerobot.utils import import_utils

_known = import_utils._diffusers_available
import_utils._diffusers_available = False
try:
    import lerobot.policies.factory  # noqa: F401  reason: for every model process
finally:
    import_utils._diffusers_available = _known
