"""How the bytes of each GPU are divided, for charts. Reads only."""

from collections.abc import Mapping
from dataclasses import dataclass

from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.arbiter.core.model.state import Core


@dataclass(frozen=True, slots=True)
class GpuUsage:
    """Bytes of one GPU. `consumers`, `pending_free_bytes` and `retained_bytes` add up to what is
    charged."""

    index: int
    consumers: Mapping[str, int]  # charges, by consumer
    pending_free_bytes: int  # charged to leases that released and are not verified yet
    retained_bytes: int  # charged to live processes outside their leases
    stowaway_bytes: int
    used_bytes: int | None  # by the newest reading; None: the GPU is unknown


def usage(core: Core) -> tuple[GpuUsage, ...]:
    """Return how the bytes of each GPU are divided now. O(leases with bytes)."""
    return tuple(_usage_of(core, gpu) for gpu in core.gpus.values())


def _usage_of(core: Core, gpu: Gpu) -> GpuUsage:
    consumers: dict[str, int] = {}
    pending_bytes = 0
    for lease_id, charge in gpu.ledger.charges.items():
        lease = core.leases.get(lease_id)
        if lease is None or lease.state is LeaseState.VERIFYING:
            pending_bytes += charge.charged_bytes
        else:
            name = lease.spec.consumer
            consumers[name] = consumers.get(name, 0) + charge.charged_bytes
    rest_bytes = gpu.ledger.charged_bytes - pending_bytes - sum(consumers.values())
    sample = gpu.sample if gpu.failed_at is None else None
    return GpuUsage(
        index=gpu.info.index,
        consumers=consumers,
        pending_free_bytes=pending_bytes,
        retained_bytes=max(0, rest_bytes),
        stowaway_bytes=gpu.ledger.stowaway_bytes,
        used_bytes=None if sample is None else sample.used_bytes,
    )
