"""lerobot's robots and teleoperators by their type's name, not connected.

The configuration is read by lerobot's own reader; every mistake is a ConfigError that names the
field. lerobot is imported when a device is made.
"""

from __future__ import annotations

import dataclasses
import importlib
import pkgutil
from collections.abc import Mapping
from typing import Any, Literal

from vram_arbiter.runner.params import wrong
from vram_arbiter.runner.robots.units import JointUnit
from vram_arbiter.schemas.findings import did_you_mean

LEROBOT = "lerobot:"


Word = Literal["robot", "teleoperator"]


def make_device(word: Word, kind: str, transport: Mapping[str, Any]) -> Any:
    """Return a device of lerobot's, not connected.

    Args: `transport` are the fields of lerobot's configuration. Raises ConfigError.
    """
    try:
        package = importlib.import_module(f"lerobot.{word}s")
        registry = getattr(package, f"{word.capitalize()}Config")
        make = getattr(package, f"make_{word}_from_config")
    except ImportError as error:
        problem = f"{LEROBOT}{kind} needs lerobot: pip install 'vram-arbiter[sidecars]' ({error})"
        raise wrong("adapter", problem) from error
    known = _types(package, registry, kind)
    if kind not in known:
        problem = f"lerobot knows no {word} {kind!r}{did_you_mean(kind, known)}"
        raise wrong("adapter", problem)
    config_class = registry.get_choice_class(kind)
    fields = {field.name for field in dataclasses.fields(config_class) if field.init}
    if transport.get("cameras"):
        raise wrong("transport.cameras", "cameras belong under `sensors`")
    for key in transport:
        if key not in fields:
            problem = f"unknown key{did_you_mean(key, sorted(fields))}"
            raise wrong(f"transport.{key}", problem)
    import draccus

    try:
        # lerobot's own reader: it turns texts into the types of its fields
        return make(draccus.decode(config_class, dict(transport)))
    except draccus.utils.DecodingError as error:
        path = (str(part) for part in getattr(error, "key_path", ()))
        text = str(getattr(error, "message", error))
        raise wrong(".".join(("transport", *path)), text) from error
    except (ImportError, TypeError, ValueError, OSError) as error:
        raise wrong("transport", f"lerobot cannot make a {kind}: {error}") from error


def _types(package: Any, registry: Any, wanted: str) -> list[str]:
    """Return lerobot's types of one family.

    Its packages register theirs on import, hence one after the other until `wanted` is there.
    """
    from lerobot.utils.import_utils import register_third_party_plugins

    if wanted not in registry.get_known_choices():
        for module in pkgutil.iter_modules(package.__path__):
            if not module.ispkg:
                continue
            try:
                importlib.import_module(f"{package.__name__}.{module.name}")
            except ImportError:  # its driver is not installed
                continue
            if wanted in registry.get_known_choices():
                break
        else:
            register_third_party_plugins()
    return sorted(registry.get_known_choices())


def bus_unit(device: Any, name: str) -> JointUnit | None:
    """Return what lerobot's motor bus turns this motor's counts into; None: there is no bus."""
    motor = getattr(getattr(device, "bus", None), "motors", {}).get(name)
    return (
        {
            "degrees": JointUnit.DEG,
            "range_0_100": JointUnit.PERCENT,
            "range_m100_100": JointUnit.SIGNED_PERCENT,
        }.get(str(motor.norm_mode.value))
        if motor is not None
        else None
    )
