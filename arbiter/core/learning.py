"""What the engine learns: footprints, durations, returns, switches, and loads that keep failing.

Footprints. Declared ones are estimates, and estimates are wrong by gigabytes. A request is charged
the larger of what it declares and the 95th percentile of what was measured; an out-of-memory report
counts for the next loads whatever they measure. A footprint changes no charge: it counts from the
next acquire on. In the order of a lease's life:

1. `Footprints.expected_bytes`: what a request is charged (`grants.settle_for_less`: where that is
   too much).
2. `on_evidence`: a reading shows a lease. While it loads, its GPU is read often (`probe_load_s`),
   so that the peak between two readings is short; a sampled peak is a lower bound all the same, so
   only one above the declared is drift. A resident is followed until it leaves. A process with
   several leases on one GPU shows one sum, of which nothing is learned.
3. `on_ready`, `on_leaving`, `on_verdict`: load peak, steady bytes and retained bytes of one life.
4. `drift_bytes`, `footprint`: declared beside measured, for `status` and `why`.

Costs. Durations, returns and switches order victims that are otherwise alike, and stretch a
residency within a cap: nothing learned can make a wait endless. A program that dies in its load is
often started again at once, and each start would empty the GPU for a load that fails: after a few
failures in a row an acquire that needs an eviction is refused for a while, twice as long after each
(`check_load`). What fits beside everything else is granted as ever. One load that succeeds forgets
the failures; so does a restart.

Names are free, so every table has a bound.
"""

from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import dataclass, field
from math import ceil, inf
from statistics import median
from typing import Any, Final, Literal

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Verification
from vram_arbiter.arbiter.core.model.refusals import LoadFails, Refused
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.explained import FootprintView
from vram_arbiter.schemas.wire.notes import DriftNote
from vram_arbiter.schemas.wire.spec import LeaseSpec

_RESIDENT = frozenset({LeaseState.HELD, LeaseState.REVOKING})

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


def model_name(spec: LeaseSpec) -> str:
    """Return the name under which a footprint is learned: another consumer of the same model may
    load it in another way.
    """
    return f"{spec.consumer} {spec.model}"


# -- tables: footprints
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
    """Measured footprints by model name (`model_name`)."""

    def __init__(self, most_bytes: int) -> None:
        self._most_bytes = most_bytes  # the largest GPU's budget
        self._models: dict[str, Measured] = {}

    def expected_bytes(self, spec: LeaseSpec) -> tuple[int, int]:
        """Return (load peak, steady) of a request: the larger of declared and learned.

        Learned bytes alone never exceed the largest GPU's budget.
        """
        name, declared = model_name(spec), spec.footprint
        learned = min(self.p95_bytes(name, "steady"), self._most_bytes)
        steady = max(declared.steady_bytes, declared.residue_bytes, learned)
        learned = min(self.p95_bytes(name, "load_peak"), self._most_bytes)
        return max(declared.load_peak_bytes, steady, learned), steady

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

    def _model(self, name: str) -> Measured:
        return newest(self._models, name, Measured, MODELS_MAX)


def _counts(value: object) -> list[int]:
    if not isinstance(value, list):
        return []
    return [count for count in value if isinstance(count, int) and count > 0]


# -- tables: costs
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

    def usual_s(self, consumer: str, phases: Iterable[str]) -> float | None:
        """Return how long these phases together take; None: one was never seen."""
        times = [self.learnt_s(consumer, phase) for phase in phases]
        known = [seconds for seconds in times if seconds is not None]
        return sum(known) if len(known) == len(times) else None

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


# -- 2. what a reading shows
def on_evidence(gpu: Gpu, now: float) -> Iterator[tuple[DriftNote, Lease]]:
    """Follow the leases that the newest reading shows; the ledger has taken its evidence. Yield
    the drifts to be noted."""
    for account in gpu.ledger.accounts.values():
        held = account.measured_bytes
        lease = (
            gpu.residents.get(next(iter(account.charges))) if len(account.charges) == 1 else None
        )
        if lease is None or not held:
            continue
        observed = lease.observed
        if lease.state is LeaseState.LOADING:
            if held > observed.peak_bytes:
                observed.peak_bytes, observed.grew_at = held, now
        elif lease.state in _RESIDENT:
            observed.steady_bytes = max(observed.steady_bytes, held)
            if held > lease.spec.footprint.steady_bytes:
                for note in _drift(gpu, lease, "steady", held):
                    yield note, lease


# -- 3. one life
def on_ready(
    footprints: Footprints, gpu: Gpu, lease: Lease, measured_bytes: int | None
) -> list[DriftNote]:
    """Learn the load peak. `measured_bytes` is the holder's own word, as good as a reading. Return
    the drifts to be noted."""
    lease.observed.steady_bytes = measured_bytes or 0
    drifts: list[DriftNote] = []
    peak = max(lease.observed.peak_bytes, measured_bytes or 0)
    if peak:
        footprints.measured(model_name(lease.spec), "load_peak", peak)
    if peak > lease.spec.footprint.load_peak_bytes:
        drifts += _drift(gpu, lease, "load_peak", peak)
    if measured_bytes:
        drifts += _drift(gpu, lease, "steady", measured_bytes)
    return drifts


def on_leaving(footprints: Footprints, gpu: Gpu, lease: Lease) -> list[DriftNote]:
    """Learn the most that a lease took while it was resident. A load that was cut off says only
    that it was too much. Return the drifts to be noted."""
    observed, part, most = lease.observed, PARTS[0], 0
    if observed.steady_bytes:
        part, most = "steady", observed.steady_bytes
    elif observed.peak_bytes > lease.request.load_peak_bytes:
        most = observed.peak_bytes
    observed.peak_bytes = observed.steady_bytes = 0  # it may return from standby and load again
    if not most:
        return []
    footprints.measured(model_name(lease.spec), part, most)
    return _drift(gpu, lease, part, most)


def on_verdict(
    footprints: Footprints, costs: Costs, gpu: Gpu, verification: Verification, now: float
) -> None:
    """Learn what a living process retains, how long its bytes took to return, and from now on
    whether it is wanted again soon. Called before the charge of its lease is dropped."""
    consumer, process = verification.consumer, verification.process
    alone = len(gpu.ledger.accounts[process].charges) == 1
    if alone and not verification.vanishes and (held := gpu.shown_bytes(process)):
        footprints.measured(verification.model, "residue", held)
    costs.learn(consumer, "verify_s", now - verification.confirmed_at)
    costs.left(consumer, now)


def _drift(gpu: Gpu, lease: Lease, part: Part, measured_bytes: int) -> list[DriftNote]:
    """Return the note of a drift beyond the tolerance, once per lease and part."""
    sizes, drifted = lease.spec.footprint, lease.observed.drifted
    declared = sizes.load_peak_bytes if part == "load_peak" else sizes.steady_bytes
    drift = measured_bytes - declared
    if part in drifted or abs(drift) <= gpu.ledger.tolerance_bytes:
        return []
    drifted.add(part)
    return [DriftNote(part, declared, measured_bytes, drift)]


# -- 4. declared beside measured
def held_bytes(gpus: Mapping[GpuId, Gpu], lease: Lease) -> int:
    """Return what the newest reading shows of a lease, else the holder's word; 0: unknown, or it
    has no GPU."""
    if lease.gpu is None:
        return 0
    account = gpus[lease.gpu].ledger.accounts[lease.process]
    shown_bytes = account.measured_bytes if len(account.charges) == 1 else 0
    return shown_bytes or lease.observed.reported_bytes or 0


def drift_bytes(gpus: Mapping[GpuId, Gpu], lease: Lease) -> int:
    """Return how far a resident lease is above (below: negative) what it declared; 0 within the
    tolerance and where it is unknown."""
    if lease.gpu is None or lease.state not in _RESIDENT:
        return 0
    declared = lease.spec.footprint.steady_bytes
    drift = (held_bytes(gpus, lease) or declared) - declared
    return drift if abs(drift) > gpus[lease.gpu].ledger.tolerance_bytes else 0


def footprint(footprints: Footprints, gpus: Mapping[GpuId, Gpu], lease: Lease) -> FootprintView:
    """Return bytes per part, declared and learned, for `why`; learned 0: never measured."""
    spec = lease.spec
    declared = {
        "load_peak": spec.footprint.load_peak_bytes,
        "steady": spec.footprint.steady_bytes,
        "residue": spec.footprint.residue_bytes,
    }
    learned = {str(part): footprints.p95_bytes(model_name(spec), part) for part in PARTS}
    return FootprintView(declared, learned, held_bytes(gpus, lease) or None)


# -- 5. loads that keep failing
def check_load(
    costs: Costs, gpus: Iterable[Gpu], spec: LeaseSpec, load_peak_bytes: int, now: float
) -> None:
    """Refuse an acquire that would need an eviction for one more try of a load that keeps failing.

    Raises Refused.
    """
    name = model_name(spec)
    wait_s = costs.pause_s(name, now)
    if not wait_s:
        return
    for gpu in gpus:
        free_bytes = gpu.ledger.budget_bytes - gpu.ledger.total_bytes()
        alone = not (spec.exclusive and gpu.residents)
        if gpu.queue.head is None and alone and load_peak_bytes <= free_bytes:
            return
    seen = costs.failures[name]
    raise Refused(LoadFails(spec.consumer, spec.model, seen.count, seen.cause, wait_s))
