"""What leases really take, learned from readings and from their holders' words, and which drift
from what it declared.

While a lease loads, its card is read often (`load_probe_s`), so that the peak between two readings
is short; a sampled peak is a lower bound all the same, so only one *above* the declared is drift.
What is resident is followed until it leaves. A process with several leases on one card shows one
sum: nothing is learnt from it. Changes no charge: a footprint counts from the next acquire on.
"""

from vram_arbiter.arbiter.core.events import LeaseSpec
from vram_arbiter.arbiter.core.learning.footprints import PARTS, Part
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.arbiter.core.model.verification import Verification
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.explained import FootprintView

_RESIDENT = frozenset({LeaseState.HELD, LeaseState.REVOKING})


def model_name(spec: LeaseSpec) -> str:
    """Under which name a footprint is learnt: another consumer of the same model may load it in
    another way.
    """
    return f"{spec.consumer} {spec.key}"


# -- what a request is charged ---------------------------------------------------------------------
def expected_bytes(core: Core, spec: LeaseSpec) -> tuple[int, int]:
    """(load peak, steady): the larger of declared and learnt.

    Learnt bytes alone never exceed the largest card's budget.
    """
    name = model_name(spec)
    steady_learnt = core.footprints.p95_bytes(name, "steady")
    peak_learnt = core.footprints.p95_bytes(name, "load_peak")
    if steady_learnt or peak_learnt:
        most = max(gpu.ledger.budget_bytes for gpu in core.gpus.values())
        steady_learnt, peak_learnt = min(steady_learnt, most), min(peak_learnt, most)
    steady = max(spec.steady_bytes, spec.residue_bytes, steady_learnt)
    return max(spec.load_peak_bytes, steady, peak_learnt), steady


# -- what is seen
def on_evidence(core: Core, gpu: Gpu) -> None:
    """The ledger has taken the evidence of a reading."""
    for account in gpu.ledger.accounts.values():
        lease = gpu.residents.get(next(iter(account.charges), LeaseId("")))
        if lease is None or not (held := measured_bytes(gpu, lease)):
            continue
        if lease.state is LeaseState.LOADING:
            if held > lease.observed.peak_bytes:
                lease.observed.peak_bytes, lease.observed.grew_at = held, core.now
        elif lease.state in _RESIDENT and not _size_changes(
            core, lease
        ):  # else its bytes may still be on the way back
            lease.observed.steady_bytes = max(lease.observed.steady_bytes, held)
            if held > lease.spec.steady_bytes:
                _note_drift(core, lease, "steady", held)


def on_ready(core: Core, lease: Lease, measured: int | None) -> None:
    """Loaded. `measured` is the holder's own word, as good as a reading."""
    lease.observed.steady_bytes = measured or 0
    peak = max(lease.observed.peak_bytes, measured or 0)
    if peak:
        core.footprints.measured(model_name(lease.spec), "load_peak", peak)
    if peak > lease.spec.load_peak_bytes:
        _note_drift(core, lease, "load_peak", peak)
    if measured:
        _note_drift(core, lease, "steady", measured)


def on_leaving(core: Core, lease: Lease) -> None:
    """It lets go, was lost, or expired: what it took at most is one life's figure. A load that was
    cut off says only if it was too much."""
    if lease.observed.steady_bytes:
        core.footprints.measured(model_name(lease.spec), "steady", lease.observed.steady_bytes)
        _note_drift(core, lease, "steady", lease.observed.steady_bytes)
    elif lease.observed.peak_bytes > lease.request.load_peak_bytes:
        core.footprints.measured(model_name(lease.spec), "load_peak", lease.observed.peak_bytes)
        _note_drift(core, lease, "load_peak", lease.observed.peak_bytes)
    lease.observed.peak_bytes = lease.observed.steady_bytes = (
        0  # it may come back from standby and load again
    )


def on_verdict(core: Core, gpu: Gpu, verification: Verification) -> None:
    """A living process has given its lease back: what it holds now is its residue. Called before
    its charge is dropped."""
    account = gpu.ledger.accounts[verification.process]
    if verification.vanishes or gpu.sample is None or len(account.charges) > 1:
        return
    held = gpu.sample.bytes_of(verification.process)
    if held:
        core.footprints.measured(verification.model, "residue", held)


# -- what is shown
def measured_bytes(gpu: Gpu, lease: Lease) -> int:
    """What the newest reading shows of a lease; 0: it cannot say."""
    account = gpu.ledger.accounts[lease.process]
    return account.measured_bytes if len(account.charges) == 1 else 0


def _size_changes(core: Core, lease: Lease) -> bool:
    return any(feature.size_changes(lease) for feature in lease.features)


def held_bytes(gpu: Gpu, lease: Lease) -> int:
    """The newest reading, else the holder's own word; 0: unknown."""
    return measured_bytes(gpu, lease) or lease.observed.reported_bytes or 0


def drift_bytes(core: Core, gpu: Gpu, lease: Lease) -> int:
    """How far a resident lease is above (below: negative) what it declared; within the tolerance it
    is 0, as where it is unknown."""
    if lease.state not in _RESIDENT or _size_changes(core, lease):
        return 0
    drift = (held_bytes(gpu, lease) or lease.spec.steady_bytes) - lease.spec.steady_bytes
    return drift if abs(drift) > core.settings.verify_tolerance_bytes else 0


def footprint(core: Core, lease: Lease) -> FootprintView:
    """Declared against learnt, for `why`: bytes per part; learnt 0: never measured."""
    spec = lease.spec
    declared = {
        "load_peak": spec.load_peak_bytes,
        "steady": spec.steady_bytes,
        "residue": spec.residue_bytes,
    }
    learnt = {part: core.footprints.p95_bytes(model_name(spec), part) for part in PARTS}
    held = 0 if lease.gpu is None else held_bytes(core.gpu_of(lease), lease)
    return FootprintView(
        declared, {str(part): count for part, count in learnt.items()}, held or None
    )


def _note_drift(core: Core, lease: Lease, part: Part, measured: int) -> None:
    """Said once per lease and part."""
    declared = lease.spec.load_peak_bytes if part == "load_peak" else lease.spec.steady_bytes
    drift = measured - declared
    if part in lease.observed.drifted or abs(drift) <= core.settings.verify_tolerance_bytes:
        return
    lease.observed.drifted.add(part)
    core.note(
        "drift",
        lease,
        part=part,
        declared_bytes=declared,
        measured_bytes=measured,
        drift_bytes=drift,
    )
