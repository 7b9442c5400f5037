"""Tables of what was learned: `Footprints` of models, and `Costs` of consumers.

They know nothing of leases or GPUs. Names are free, so every table has a bound.
"""

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from math import ceil, inf
from statistics import median
from typing import Any, Final, Literal

HISTORY_MAX = 64
"""Measurements remembered per model and part."""
MODELS_MAX = 256
"""Models remembered; the ones not heard of for longest are forgotten."""
OOM_LOADS = 20
"""An out-of-memory report holds for so many loads; with fewer measurements the 95th percentile is
their maximum anyway."""

type Part = Literal["load_peak", "steady", "residue"]
PARTS: tuple[Part, ...] = ("load_peak", "steady", "residue")
LEARNT_REMEMBERED: Final = 32
CONSUMERS_REMEMBERED: Final = 1024
REUSE_WITHIN_S: Final = 60.0
"""A consumer that is wanted again this soon after it left should rather have stayed."""
FREE: Final = 2
"""So many failures in a row cost nothing: the first may be an accident, the second the same one."""
PAUSE_S: Final = 2.0
PAUSE_MAX_S: Final = 60.0
FORGOTTEN_S: Final = 600.0
NAMES_MAX: Final = 256


def newest[K, T](table: dict[K, T], name: K, make: Callable[[], T], most: int) -> T:
    """Return the entry of a name, made if there is none, as the newest one of its table; the oldest
    beyond `most` are forgotten."""
    entry = table[name] = table.pop(name) if name in table else make()
    while len(table) > most:
        del table[next(iter(table))]
    return entry


# -- footprints ----------------------------------------------------------------------------------
@dataclass(slots=True)
class Measured:
    """One model's measurements in bytes, oldest first."""

    seen: dict[Part, deque[int]] = field(
        default_factory=lambda: {part: deque(maxlen=HISTORY_MAX) for part in PARTS}
    )
    p95: dict[Part, int] = field(default_factory=dict)
    oom_bytes: int = 0  # it needed at least this when an allocation failed
    oom_loads: int = 0  # loads for which that still holds


class Footprints:
    """Measured footprints by model name (`model_name`). Knows nothing of leases or GPUs."""

    def __init__(self) -> None:
        self._models: dict[str, Measured] = {}

    def measured(self, name: str, part: Part, *counts: int) -> None:
        """Add the figures of loads, or of whole lives, oldest first."""
        model = self._model(name)
        seen = model.seen[part]
        seen.extend(counts)
        if seen:
            model.p95[part] = sorted(seen)[ceil(0.95 * len(seen)) - 1]
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
        """Return the 95th percentile (nearest rank) of what was measured, at least what an
        out-of-memory report asked for; 0: never seen."""
        model = self._models.get(name)
        if model is None:
            return 0
        found = model.p95.get(part, 0)
        return max(found, model.oom_bytes) if part == "load_peak" else found

    def kept(self) -> dict[str, dict[str, list[int]]]:
        """Return everything as plain values, for `restore` after a restart."""
        return {
            name: {
                **{part: list(seen) for part, seen in model.seen.items() if seen},
                **({"oom": [model.oom_bytes, model.oom_loads]} if model.oom_loads else {}),
            }
            for name, model in self._models.items()
        }

    def restore(self, kept: Mapping[str, Mapping[str, Any]]) -> None:
        """Take what `kept` gave, perhaps long ago and by another version: what is not understood is
        left out."""
        for name, parts in kept.items():
            for part in PARTS:
                self.measured(name, part, *_counts(parts.get(part)))
            match _counts(parts.get("oom")):
                case [count, loads]:
                    model = self._model(name)
                    model.oom_bytes, model.oom_loads = count, min(loads, OOM_LOADS)
                case _:
                    pass

    def _model(self, name: str) -> Measured:
        return newest(self._models, name, Measured, MODELS_MAX)


def _counts(value: object) -> list[int]:
    if not isinstance(value, list):
        return []
    return [count for count in value if isinstance(count, int) and count > 0]


# -- costs ---------------------------------------------------------------------------------------
@dataclass(slots=True)
class Reuse:
    """Departures of one consumer: was it wanted again soon?"""

    left_at: float | None = None
    soon: deque[bool] = field(default_factory=lambda: deque(maxlen=LEARNT_REMEMBERED))

    def chance(self) -> float:
        """Half for one that is not known, nearer to what was seen with every departure."""
        return (1 + sum(self.soon)) / (2 + len(self.soon))


@dataclass(slots=True)
class Failures:
    """Loads of one model that failed in a row."""

    count: int = 0
    last_at: float = -inf
    cause: str = ""  # of the last


class Costs:
    """Durations, returns and switches of consumers, and failed loads of models; the newest last."""

    def __init__(self, learnt: Mapping[str, Mapping[str, float]], switch_window_s: float) -> None:
        self._switch_window_s = switch_window_s
        self.durations: dict[str, dict[str, deque[float]]] = {}
        self.reuse: dict[str, Reuse] = {}
        self.switches: dict[tuple[str, str], float] = {}
        """(consumer that left, consumer it left for) → when last."""
        self.failures: dict[str, Failures] = {}
        for consumer, phases in sorted(learnt.items()):
            for phase, seconds in sorted(phases.items()):
                self.learn(consumer, phase, seconds)

    # -- durations
    def learn(self, consumer: str, phase: str, seconds: float) -> None:
        """Remember how long a phase (`drain_s`, `unload_s`, `verify_s`, `load_s`) took."""
        phases = newest(self.durations, consumer, dict[str, deque[float]], CONSUMERS_REMEMBERED)
        phases.setdefault(phase, deque(maxlen=LEARNT_REMEMBERED)).append(max(0.0, seconds))

    def learnt_s(self, consumer: str, phase: str) -> float | None:
        """Return the median of what was learned; None: never seen."""
        seen = self.durations.get(consumer, {}).get(phase)
        return median(seen) if seen else None

    def medians(self) -> dict[str, dict[str, float]]:
        """Return what was learned, in the shape of `Settings.learnt`."""
        return {
            consumer: {phase: median(seen) for phase, seen in phases.items()}
            for consumer, phases in self.durations.items()
        }

    # -- returns
    def left(self, consumer: str, now: float) -> None:
        """A consumer's bytes are gone: whether it is wanted again soon is learned from now on."""
        newest(self.reuse, consumer, Reuse, CONSUMERS_REMEMBERED).left_at = now

    def wanted(self, consumer: str, now: float) -> None:
        """Learn whether a consumer is wanted again soon after it left."""
        seen = self.reuse.get(consumer)
        if seen is not None and seen.left_at is not None:
            seen.soon.append(now - seen.left_at <= REUSE_WITHIN_S)
            seen.left_at = None

    def reload_s(self, consumer: str) -> float:
        """Return the seconds of loading that a departure is expected to cost, to a tenth; 0:
        unknown."""
        chance = self.reuse.get(consumer, Reuse()).chance()
        return round((self.learnt_s(consumer, "load_s") or 0.0) * chance, 1)

    # -- switches
    def switched(self, gone: str, came: str, now: float) -> None:
        """Note that a consumer made room for another; forget pairs that did not switch lately."""
        since = now - self._switch_window_s
        for pair in [pair for pair, at in self.switches.items() if at <= since]:
            del self.switches[pair]
        self.switches[gone, came] = now

    def switch_s(self, one: str, other: str, now: float) -> float:
        """Return the cost of one more switch between two consumers that keep evicting each other;
        0 if they have not switched both ways lately."""
        both_at = min(self.switches.get((one, other), -inf), self.switches.get((other, one), -inf))
        if both_at <= now - self._switch_window_s:
            return 0.0
        phases = ((one, "unload_s"), (one, "verify_s"), (other, "load_s"))
        return sum(self.learnt_s(consumer, phase) or 0.0 for consumer, phase in phases)

    # -- failed loads
    def load_failed(self, model: str, cause: str, now: float) -> None:
        """A holder died, or was lost, while it loaded."""
        seen = newest(self.failures, model, Failures, NAMES_MAX)
        seen.count = 1 if now - seen.last_at > FORGOTTEN_S else seen.count + 1
        seen.last_at, seen.cause = now, cause

    def pause_s(self, model: str, now: float) -> float:
        """Return for how long no eviction is spent on a load of this model."""
        seen = self.failures.get(model)
        if seen is None or seen.count <= FREE:
            return 0.0
        pause_s = min(PAUSE_MAX_S, PAUSE_S * 2.0 ** (seen.count - FREE - 1))
        return max(0.0, seen.last_at + pause_s - now)
