"""Where the shipped data is: skills, models, scenes. One answer for every program."""

from collections.abc import Mapping
from pathlib import Path
from typing import Literal

import schemas

CONFIGS_VARIABLE = "VRAM_ARBITER_CONFIGS"


def configs_folder(environ: Mapping[str, str]) -> Path:
    """Folder of skills, models and scenes: named by the environment, inside the installed package, or in the source tree."""
    if explicit := environ.get(CONFIGS_VARIABLE):
        return Path(explicit)
    package = Path(schemas.__file__).parent
    installed = package / "_configs"
    return installed if installed.is_dir() else package.parent / "configs"


def shipped(path: Path, kind: Literal["rskills", "robots"], configs: Path) -> Path:
    """The shipped file that a bare name such as `so101-detector` stands for; any other path as it is."""
    named = configs / kind / path / "rskill.yaml" if kind == "rskills" else configs / kind / f"{path}.yaml"
    return named if len(path.parts) == 1 and not path.exists() and named.exists() else path
