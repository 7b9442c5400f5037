"""On which cards a lease may ever be: those that its selector names, that are large enough, and on which no pin is for ever in its way.

A pin may end although nobody can ask for it; then its card becomes a place for those who wait. Knows no order and asks nobody.
"""

from arbiter.core.events import Spec
from arbiter.core.lease import LEAVING, Lease
from arbiter.core.state import Core, Gpu, Refused
from schemas.ids import GpuId


def selected(core: Core, spec: Spec) -> list[Gpu]:
    """By `any`, an uuid or an index. One that is away comes back to any of them: it is in no queue, and in nobody's way."""
    return [gpu for gpu in core.gpus.values() if spec.gpu in ("any", gpu.info.id, str(gpu.info.index))]


def places(core: Core, spec: Spec, load_peak: int) -> tuple[GpuId, ...]:
    """Cards that a new waiter stands in the queues of. Raises Refused if there is none that it could ever be granted on."""
    gpus = selected(core, spec)
    if not gpus:
        raise Refused(
            "unknown_gpu",
            f"there is no GPU {spec.gpu!r}",
            "give an uuid, an index or `any`",
            known=[gpu.info.id for gpu in core.gpus.values()],
        )
    able = tuple(gpu.info.id for gpu in gpus if _is_able(gpu, spec, load_peak))
    if able:
        return able
    largest = max(gpus, key=lambda gpu: (gpu.ledger.budget_bytes, -gpu.info.index))
    raised = load_peak > max(spec.load_peak_bytes, spec.steady_bytes, spec.residue_bytes)
    learnt = f" ({spec.load_peak_bytes} declared, more was measured)" if raised else ""
    raise Refused(
        "vram_insufficient",
        f"{spec.consumer} needs {load_peak} bytes{learnt}; the card has {largest.info.capacity_bytes} "
        f"less a reserve of {largest.info.reserve_bytes}"
        + (", and pinned leases" if any(_pins(gpu) for gpu in gpus) else ""),
        "use a smaller model or a lower precision, or unpin what is resident",
        needed_bytes=load_peak,
        declared_bytes=spec.load_peak_bytes,
        capacity_bytes=largest.info.capacity_bytes,
        reserve_bytes=largest.info.reserve_bytes,
        pinned=[
            {"lease_id": p.id, "consumer": p.spec.consumer, "bytes": largest.ledger.charge_bytes(p.id)}
            for p in _pins(largest)
        ],
    )


def reconsider(core: Core, gpu: Gpu) -> None:
    """A pin on this card ended: those who wait for others only because of it wait here too, at the place that is theirs."""
    gpu.residents.unpinned = False
    for lease in core.waiting.values():
        if lease.grows is not None or lease.gpu is not None or gpu.info.id in lease.gpus:
            continue  # a growth has its place, and an admitted gang has its cards
        if gpu not in selected(core, lease.spec) or not _is_able(gpu, lease.spec, lease.load_peak_bytes):
            continue
        if lease in core.gpus[lease.gpus[0]].queue:  # else: one of a gang that is not all here yet
            gpu.queue.add(lease)
        lease.gpus = tuple(one for one in core.gpus if one in {*lease.gpus, gpu.info.id})


def _is_able(gpu: Gpu, spec: Spec, load_peak: int) -> bool:
    if not gpu.residents.pinned:
        return load_peak <= gpu.ledger.budget_bytes
    pins = _pins(gpu)
    alone = not pins or not (spec.exclusive or any(lease.spec.exclusive for lease in pins))
    fixed = sum(gpu.ledger.charge_bytes(lease.id) for lease in pins)
    return alone and load_peak + fixed <= gpu.ledger.budget_bytes


def _pins(gpu: Gpu) -> list[Lease]:
    """Trees with a pin in them leave as a whole or not at all."""
    trees = {lease.root.id: lease.root for lease in gpu.residents.pinned.values()}
    return [lease for root in trees.values() for lease in root.tree() if lease.state not in LEAVING]
