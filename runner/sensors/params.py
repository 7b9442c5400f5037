"""`backend_params` of a deployment file, read by their backend, with errors by field.

Everything here happens while a reader is made, before any device is opened.
"""

from __future__ import annotations

import importlib.util

from pydantic import BaseModel, ConfigDict, ValidationError

from vram_arbiter.schemas.config.robot import SensorReaderConfig
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import problems_of
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.yamltext import Mistake, config_error


class BackendParams(BaseModel):
    """Base of each backend's parameters. Strict: the text "0" is not a device number."""

    model_config = ConfigDict(
        frozen=True, extra="forbid", strict=True, use_attribute_docstrings=True
    )


def read_params[P: BackendParams](config: SensorReaderConfig, model: type[P]) -> P:
    """Read the parameters of one camera.

    Raises ConfigError with every unknown, unneeded, missing or wrong one.
    """
    try:
        return model.model_validate(dict(config.backend_params))
    except ValidationError as error:
        found = [
            (problem.field, problem.message)
            for problem in problems_of(error, model, config.backend_params)
        ]
        raise _error(config, found) from error


def refuse(config: SensorReaderConfig, field: str, problem: str) -> ConfigError:
    """Return an error about one parameter, by its name below `backend_params` ("" for all)."""
    return _error(config, [(field, problem)])


def refuse_field(config: SensorReaderConfig, field: str, problem: str) -> ConfigError:
    """Return an error about one field of the camera itself."""
    return _named(config, [Mistake(0, field, problem)])


def require_module(config: SensorReaderConfig, module: str, distribution: str, extra: str) -> None:
    """Raise ConfigError unless `module` can be imported; heavy packages are imported when used."""
    if importlib.util.find_spec(module) is None:
        problem = f"{config.backend} needs {distribution}: pip install 'vram-arbiter[{extra}]'"
        raise refuse_field(config, "backend", problem)


def _error(config: SensorReaderConfig, found: list[tuple[str, str]]) -> ConfigError:
    return _named(
        config,
        [
            Mistake(0, f"backend_params.{field}" if field else "backend_params", text)
            for field, text in found
        ],
    )


def _named(config: SensorReaderConfig, problems: list[Mistake]) -> ConfigError:
    error = config_error(f"sensor {config.sensor_id}", problems)
    details: JsonObject = {**error.details, "sensor_id": config.sensor_id}
    return ConfigError(error.message, details=details)
