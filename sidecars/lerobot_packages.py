"""Optional packages of lerobot, kept out of imports that do not need them."""

import importlib
from collections.abc import Mapping, Sequence
from importlib.util import find_spec
from typing import Final, Literal

from vram_arbiter.sidecars.quantization import load_bitsandbytes
from vram_arbiter.sidecars.replaced import replaced

_FLAGS: Final[Mapping[str, tuple[str, ...]]] = {
    "diffusers": ("_diffusers_available",),
    "peft": ("_peft_available", "_wallx_deps_available"),
}
"""lerobot's record of what is installed, by package."""


def import_policies(without: Sequence[Literal["diffusers", "peft"]]) -> None:
    """Import the code of all of lerobot's policies, as if `without` were not installed.

    The other packages import bitsandbytes, which is imported first, without a GPU: it would
    initialize CUDA.
    """
    from lerobot.utils import import_utils

    if len(without) < len(_FLAGS) and find_spec("bitsandbytes") is not None:
        load_bitsandbytes()
    with replaced(import_utils, **{flag: False for name in without for flag in _FLAGS[name]}):
        importlib.import_module("lerobot.policies.factory")
