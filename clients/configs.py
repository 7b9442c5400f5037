"""Folder of the shipped data: skills, robots, models, scenes."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import vram_arbiter

CONFIGS_VARIABLE = "VRAM_ARBITER_CONFIGS"


def configs_folder(environ: Mapping[str, str]) -> Path:
    """Return the folder of skills, models and scenes: the environment's, or the installed one."""
    if explicit := environ.get(CONFIGS_VARIABLE):
        return Path(explicit)
    return Path(vram_arbiter.__file__).parent / "configs"


def shipped(path: Path, kind: Literal["rskills", "robots"], configs: Path) -> Path:
    """Return the shipped file of a bare name such as `so101-detector`; any other path as it is."""
    named = (
        configs / kind / path / "rskill.yaml"
        if kind == "rskills"
        else configs / kind / f"{path}.yaml"
    )
    return named if len(path.parts) == 1 and not path.exists() and named.exists() else path
