"""Numbered work over actors."""

from dataclasses import dataclass
from typing import Any


@dataclass(frozen=True, slots=True)
class Result:
    """What a seed's call returned, and the Ray node that it ran on."""

    seed: int
    node: str
    value: Any
