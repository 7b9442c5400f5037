"""On which cards a lease may ever be: those that its selector names and that are large enough once
every lease there has ended.

A pinned holder cannot be asked to leave, but it ends one day: a request beside it waits, as long as
its own timeout allows. Knows no order and sends no revoke.
"""

from vram_arbiter.arbiter.core.events import Spec
from vram_arbiter.arbiter.core.model import refusals as no
from vram_arbiter.arbiter.core.model.refusals import Refused
from vram_arbiter.arbiter.core.model.state import Core, Gpu
from vram_arbiter.schemas.ids import GpuId


def selected(core: Core, spec: Spec) -> list[Gpu]:
    """By `any`, an uuid or an index. One that is away comes back to any of them: it is in no queue,
    and in nobody's way."""
    return [
        gpu for gpu in core.gpus.values() if spec.gpu in ("any", gpu.info.id, str(gpu.info.index))
    ]


def places(core: Core, spec: Spec, load_peak: int) -> tuple[GpuId, ...]:
    """Cards that a new waiter stands in the queues of. Raises Refused if there is none that it
    could ever be granted on."""
    gpus = selected(core, spec)
    if not gpus:
        raise Refused(no.UnknownGpu(spec.gpu, tuple(gpu.info.id for gpu in core.gpus.values())))
    able = tuple(gpu.info.id for gpu in gpus if load_peak <= gpu.ledger.budget_bytes)
    if able:
        return able
    largest = max(gpus, key=lambda gpu: (gpu.ledger.budget_bytes, -gpu.info.index))
    info = largest.info
    sizes = (load_peak, spec.load_peak_bytes, info.capacity_bytes, info.reserve_bytes)
    raise Refused(no.TooLarge(spec.consumer, *sizes))
