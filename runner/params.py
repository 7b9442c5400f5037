"""Parameters that only a part's adapter knows: `hal.params`, `backend_params`. The adapter reads
them before a device is opened.

Every mistake is a ConfigError that names the field below the part's section of the deployment file;
the section and the line are the file's (`runner.cli.deployment.DeploymentFile.located`).
"""

from __future__ import annotations

from collections.abc import Iterable

from pydantic import BaseModel, ConfigDict, ValidationError

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import problems_of
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.yamltext import Mistake, config_error


class Params(BaseModel):
    """Base of all: an unknown field is an error."""

    model_config = ConfigDict(frozen=True, extra="forbid")


def read_params[T: Params](kind: type[T], given: JsonMap, field: str) -> T:
    """Return the parameters under `field`. Raises ConfigError with every mistake."""
    try:
        return kind.model_validate(dict(given))
    except ValidationError as error:
        found = problems_of(error, kind, given)
        raise mistakes(
            (f"{field}.{one.field}".rstrip("."), one.message) for one in found
        ) from error


def wrong(field: str, problem: str) -> ConfigError:
    """Return one mistake."""
    return mistakes([(field, problem)])


def mistakes(found: Iterable[tuple[str, str]]) -> ConfigError:
    """Return `(field, problem)` pairs as one error."""
    return config_error("deployment", [Mistake(0, *one) for one in found])
