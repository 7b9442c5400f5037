"""What the engine learns: footprints, durations, returns, switches, and loads that keep failing.

Footprints. Declared ones are estimates, and estimates are wrong by gigabytes. A request is charged
the larger of what it declares and the 95th percentile of what was measured; an out-of-memory report
counts for the next loads whatever they measure. A footprint changes no charge: it counts from the
next acquire on. In the order of a lease's life:

1. `expected_bytes`: what a request is charged (`grants.settle_for_less`: where that is too much).
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

The tables are `Footprints` and `Costs` (`model.learned`).
"""

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.learned import PARTS, Part
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState, Verification
from vram_arbiter.arbiter.core.model.refusals import LoadFails, Refused
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.explained import FootprintView
from vram_arbiter.schemas.wire.notes import DriftNote
from vram_arbiter.schemas.wire.spec import LeaseSpec

_RESIDENT = frozenset({LeaseState.HELD, LeaseState.REVOKING})


# -- 1. what a request is charged ------------------------------------------------------------------
def model_name(spec: LeaseSpec) -> str:
    """Return the name under which a footprint is learned: another consumer of the same model may
    load it in another way.
    """
    return f"{spec.consumer} {spec.model}"


def expected_bytes(core: Core, spec: LeaseSpec) -> tuple[int, int]:
    """Return (load peak, steady): the larger of declared and learned.

    Learned bytes alone never exceed the largest GPU's budget.
    """
    name = model_name(spec)
    steady_learned = core.footprints.p95_bytes(name, "steady")
    peak_learned = core.footprints.p95_bytes(name, "load_peak")
    if steady_learned or peak_learned:
        most = max(gpu.ledger.budget_bytes for gpu in core.gpus.values())
        steady_learned, peak_learned = min(steady_learned, most), min(peak_learned, most)
    steady = max(spec.footprint.steady_bytes, spec.footprint.residue_bytes, steady_learned)
    return max(spec.footprint.load_peak_bytes, steady, peak_learned), steady


# -- 2. what a reading shows -----------------------------------------------------------------------
def on_evidence(core: Core, gpu: Gpu) -> None:
    """Follow the leases that the newest reading shows; the ledger has taken its evidence."""
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
                observed.peak_bytes, observed.grew_at = held, core.now
        elif lease.state in _RESIDENT:
            observed.steady_bytes = max(observed.steady_bytes, held)
            if held > lease.spec.footprint.steady_bytes:
                _note_drift(core, lease, "steady", held)


# -- 3. one life -----------------------------------------------------------------------------------
def on_ready(core: Core, lease: Lease, measured_bytes: int | None) -> None:
    """Learn the load peak. `measured_bytes` is the holder's own word, as good as a reading."""
    lease.observed.steady_bytes = measured_bytes or 0
    peak = max(lease.observed.peak_bytes, measured_bytes or 0)
    if peak:
        core.footprints.measured(model_name(lease.spec), "load_peak", peak)
    if peak > lease.spec.footprint.load_peak_bytes:
        _note_drift(core, lease, "load_peak", peak)
    if measured_bytes:
        _note_drift(core, lease, "steady", measured_bytes)


def on_leaving(core: Core, lease: Lease) -> None:
    """Learn the most that a lease took while it was resident. A load that was cut off says only
    that it was too much."""
    observed = lease.observed
    if observed.steady_bytes:
        core.footprints.measured(model_name(lease.spec), "steady", observed.steady_bytes)
        _note_drift(core, lease, "steady", observed.steady_bytes)
    elif observed.peak_bytes > lease.request.load_peak_bytes:
        core.footprints.measured(model_name(lease.spec), "load_peak", observed.peak_bytes)
        _note_drift(core, lease, "load_peak", observed.peak_bytes)
    observed.peak_bytes = observed.steady_bytes = 0  # it may return from standby and load again


def on_verdict(core: Core, gpu: Gpu, verification: Verification) -> None:
    """Learn what a living process retains, how long its bytes took to return, and from now on
    whether it is wanted again soon. Called before the charge of its lease is dropped."""
    consumer, process = verification.consumer, verification.process
    alone = len(gpu.ledger.accounts[process].charges) == 1
    if alone and not verification.vanishes and (held := gpu.shown_bytes(process)):
        core.footprints.measured(verification.model, "residue", held)
    core.costs.learn(consumer, "verify_s", core.now - verification.confirmed_at)
    core.costs.left(consumer, core.now)


def _note_drift(core: Core, lease: Lease, part: Part, measured_bytes: int) -> None:
    """Note a drift beyond the tolerance once per lease and part."""
    sizes = lease.spec.footprint
    declared = sizes.load_peak_bytes if part == "load_peak" else sizes.steady_bytes
    drift = measured_bytes - declared
    if part in lease.observed.drifted or abs(drift) <= core.settings.verify_tolerance_bytes:
        return
    lease.observed.drifted.add(part)
    core.note(DriftNote(part, declared, measured_bytes, drift), lease)


# -- 4. declared beside measured -------------------------------------------------------------------
def held_bytes(gpu: Gpu, lease: Lease) -> int:
    """Return what the newest reading shows of a lease, else the holder's word; 0: unknown."""
    account = gpu.ledger.accounts[lease.process]
    shown_bytes = account.measured_bytes if len(account.charges) == 1 else 0
    return shown_bytes or lease.observed.reported_bytes or 0


def drift_bytes(core: Core, gpu: Gpu, lease: Lease) -> int:
    """Return how far a resident lease is above (below: negative) what it declared; 0 within the
    tolerance and where it is unknown."""
    if lease.state not in _RESIDENT:
        return 0
    declared = lease.spec.footprint.steady_bytes
    drift = (held_bytes(gpu, lease) or declared) - declared
    return drift if abs(drift) > core.settings.verify_tolerance_bytes else 0


def footprint(core: Core, lease: Lease) -> FootprintView:
    """Return bytes per part, declared and learned, for `why`; learned 0: never measured."""
    spec = lease.spec
    declared = {
        "load_peak": spec.footprint.load_peak_bytes,
        "steady": spec.footprint.steady_bytes,
        "residue": spec.footprint.residue_bytes,
    }
    learned = {str(part): core.footprints.p95_bytes(model_name(spec), part) for part in PARTS}
    held = 0 if lease.gpu is None else held_bytes(core.gpu_of(lease), lease)
    return FootprintView(declared, learned, held or None)


# -- 5. loads that keep failing -------------------------------------------------------------------
def check_load(core: Core, spec: LeaseSpec, load_peak_bytes: int, gpus: tuple[GpuId, ...]) -> None:
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
