"""What models really took: measured load peaks, steady bytes and residues per consumer and key, as
far as the last 64 loads go.

Declared footprints are estimates, and estimates are wrong by gigabytes. A request is charged the
larger of what it declares and the 95th percentile of what was measured. An out-of-memory report
counts for the next loads whatever they measure. Knows nothing of leases or cards.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import ceil
from typing import Any, Literal

HISTORY_MAX = 64
"""Measurements remembered per model and part."""
MODELS_MAX = 256
"""Models remembered; the ones not heard of for longest are forgotten."""
OOM_LOADS = 20
"""An out-of-memory report holds for so many loads; with fewer measurements the 95th percentile is
their maximum anyway."""

type Part = Literal["load_peak", "steady", "residue"]
PARTS: tuple[Part, ...] = ("load_peak", "steady", "residue")


@dataclass(slots=True)
class Measured:
    """One model's measurements in bytes, oldest first."""

    seen: dict[Part, deque[int]] = field(
        default_factory=lambda: {part: deque(maxlen=HISTORY_MAX) for part in PARTS}
    )
    p95: dict[Part, int] = field(default_factory=dict)
    oom_bytes: int = 0  # it needed at least this when an allocation failed
    oom_loads: int = 0  # loads for which that still holds

    def add(self, part: Part, counts: list[int]) -> None:
        seen = self.seen[part]
        seen.extend(counts)
        if seen:
            self.p95[part] = sorted(seen)[ceil(0.95 * len(seen)) - 1]


class Footprints:
    """Measured footprints by model name (`consumer key`)."""

    def __init__(self) -> None:
        self._models: dict[str, Measured] = {}

    def measured(self, name: str, part: Part, count: int) -> None:
        """One load's (or one life's) figure."""
        model = self._model(name)
        model.add(part, [count])
        if part == "load_peak" and model.oom_loads:
            model.oom_loads -= 1
            if not model.oom_loads:
                model.oom_bytes = 0

    def out_of_memory(self, name: str, count: int) -> None:
        """An allocation failed that would have made it so many bytes."""
        model = self._model(name)
        model.oom_bytes = max(model.oom_bytes, count)
        model.oom_loads = OOM_LOADS

    def p95_bytes(self, name: str, part: Part) -> int:
        """95th percentile (nearest rank) of what was measured, at least what an out-of-memory
        report asked for; 0: never seen."""
        model = self._models.get(name)
        if model is None:
            return 0
        found = model.p95.get(part, 0)
        return max(found, model.oom_bytes) if part == "load_peak" else found

    def kept(self) -> dict[str, dict[str, list[int]]]:
        """Everything as plain values, for `restore` after a restart."""
        return {
            name: {
                **{part: list(seen) for part, seen in model.seen.items() if seen},
                **({"oom": [model.oom_bytes, model.oom_loads]} if model.oom_loads else {}),
            }
            for name, model in self._models.items()
        }

    def restore(self, kept: Mapping[str, Mapping[str, Any]]) -> None:
        """What `kept` gave, perhaps long ago and by another version: what is not understood is left
        out."""
        for name, parts in kept.items():
            model = self._model(name)
            for part in PARTS:
                model.add(part, _counts(parts.get(part)))
            match _counts(parts.get("oom")):
                case [count, loads]:
                    model.oom_bytes, model.oom_loads = count, min(loads, OOM_LOADS)
                case _:
                    pass

    def _model(self, name: str) -> Measured:
        model = self._models.pop(name, None) or Measured()
        self._models[name] = model  # the newest last
        while len(self._models) > MODELS_MAX:
            del self._models[next(iter(self._models))]
        return model


def _counts(value: object) -> list[int]:
    if not isinstance(value, list):
        return []
    return [count for count in value if isinstance(count, int) and count > 0]
