"""What departures, returns and failed loads cost, learned from what was seen.

Durations, returns and switches order victims that are otherwise alike, and stretch a residency
within a cap: nothing learned can make a wait endless.

A program that dies in its load is often started again at once, and each start would empty the GPU
for a load that fails. After a few failures in a row an acquire that needs an eviction is refused
for a while, twice as long after each. What fits beside everything else is granted as ever. One load
that succeeds forgets the failures; so does a restart.

`Costs` knows nothing of leases or GPUs. Names are free, so every table has a bound.
"""

from collections import deque
from collections.abc import Mapping
from dataclasses import dataclass, field
from math import inf
from statistics import median
from typing import TYPE_CHECKING, Final

from vram_arbiter.arbiter.core.learning.footprints import model_name
from vram_arbiter.arbiter.core.model.refusals import LoadFails, Refused
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.spec import LeaseSpec

if TYPE_CHECKING:  # the state has a table of costs
    from vram_arbiter.arbiter.core.model.state import Core

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


@dataclass(slots=True)
class Reuse:
    """Departures of one consumer: was it wanted again soon?"""

    left_at: float | None = None
    soon: deque[bool] = field(default_factory=lambda: deque(maxlen=LEARNT_REMEMBERED))

    def chance(self) -> float:
        """Half for one that is not known, nearer to what was seen with every departure."""
        return (1 + sum(self.soon)) / (2 + len(self.soon))


@dataclass(frozen=True, slots=True)
class Failures:
    """Loads of one model that failed in a row."""

    count: int
    last_at: float
    cause: str  # of the last


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
        phases = self.durations.pop(consumer, {})
        phases.setdefault(phase, deque(maxlen=LEARNT_REMEMBERED)).append(max(0.0, seconds))
        _put(self.durations, consumer, phases, CONSUMERS_REMEMBERED)

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
        seen = self.reuse.pop(consumer, None) or Reuse()
        seen.left_at = now
        _put(self.reuse, consumer, seen, CONSUMERS_REMEMBERED)

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
        before = self.failures.pop(model, None)
        count = 0 if before is None or now - before.last_at > FORGOTTEN_S else before.count
        _put(self.failures, model, Failures(count + 1, now, cause), NAMES_MAX)

    def pause_s(self, model: str, now: float) -> float:
        """Return for how long no eviction is spent on a load of this model."""
        seen = self.failures.get(model)
        if seen is None or seen.count <= FREE:
            return 0.0
        pause_s = min(PAUSE_MAX_S, PAUSE_S * 2.0 ** (seen.count - FREE - 1))
        return max(0.0, seen.last_at + pause_s - now)


def check_load(
    core: "Core", spec: LeaseSpec, load_peak_bytes: int, gpus: tuple[GpuId, ...]
) -> None:
    """Refuse an acquire that would need an eviction for one more try of a load that keeps failing.

    Raises Refused.
    """
    name = model_name(spec)
    wait_s = core.costs.pause_s(name, core.now)
    if not wait_s:
        return
    for gpu in (core.gpus[gpu_id] for gpu_id in gpus):
        free_bytes = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
        alone = not (spec.exclusive and gpu.residents)
        if gpu.queue.head is None and alone and load_peak_bytes <= free_bytes:
            return
    seen = core.costs.failures[name]
    raise Refused(LoadFails(spec.consumer, spec.model, seen.count, seen.cause, wait_s))


def _put[T](table: dict[str, T], name: str, value: T, most: int) -> None:
    table[name] = value
    while len(table) > most:
        del table[next(iter(table))]
