"""Where the shipped data is: skills, models, scenes. One answer for every program."""

from collections.abc import Mapping
from pathlib import Path

import schemas

CONFIGS_VARIABLE = "VRAM_ARBITER_CONFIGS"


def configs_folder(environ: Mapping[str, str]) -> Path:
    """Folder of skills, models and scenes: named by the environment, inside the installed package, or in the source tree."""
    if explicit := environ.get(CONFIGS_VARIABLE):
        return Path(explicit)
    package = Path(schemas.__file__).parent
    installed = package / "_configs"
    return installed if installed.is_dir() else package.parent / "configs"
