"""What the GPUs hold, by consumer, from a status: for metrics and for the page's charts. Pure."""

from collections.abc import Iterator, Mapping
from dataclasses import dataclass

from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import GpuView, LeaseView

RESIDUES = "(residues)"
"""Stands for bytes that no resident lease has: residues of living processes, debts of leases that
are over."""
STOWAWAYS = "(stowaways)"
"""Stands for processes without a lease."""
UNATTRIBUTED = "(unattributed)"
"""Stands for bytes of a reading that no listed process explains."""
_VERIFYING = "verifying"


@dataclass(frozen=True, slots=True)
class GpuUsage:
    """Charges of one GPU, divided. `consumers`, `pending_free_bytes` and `retained_bytes` add up to
    what is charged."""

    index: int
    consumers: Mapping[str, int]
    pending_free_bytes: int  # of leases that released and are not verified yet
    retained_bytes: int  # of live processes outside their leases
    stowaway_bytes: int
    used_bytes: int | None  # by the newest reading; None: the GPU is unknown


def usage(status: StatusReply) -> tuple[GpuUsage, ...]:
    """Return how the bytes of each GPU are divided."""
    return tuple(_usage_of(gpu, status) for gpu in status.gpus)


def _usage_of(gpu: GpuView, status: StatusReply) -> GpuUsage:
    consumers: dict[str, int] = {}
    pending_bytes = 0
    for lease in _on(gpu, status):
        if lease.state == _VERIFYING:
            pending_bytes += lease.charge_bytes
        else:
            consumers[lease.consumer] = consumers.get(lease.consumer, 0) + lease.charge_bytes
    pending_bytes += sum(_debts(gpu, status))
    rest_bytes = gpu.charged_bytes - pending_bytes - sum(consumers.values())
    return GpuUsage(
        index=gpu.index,
        consumers=consumers,
        pending_free_bytes=pending_bytes,
        retained_bytes=max(0, rest_bytes),
        stowaway_bytes=gpu.stowaway_bytes,
        used_bytes=gpu.measured_used_bytes,
    )


def _debts(gpu: GpuView, status: StatusReply) -> Iterator[int]:
    """Yield what processes are charged for leases that are over."""
    charges = {lease.lease_id: lease.charge_bytes for lease in status.leases}
    for process in gpu.processes:
        if any(lease not in charges for lease in process.lease_ids):
            own = sum(charges.get(lease, 0) for lease in process.lease_ids)
            yield max(0, process.charged_bytes - own)


def charged(gpu: GpuView, status: StatusReply) -> Mapping[str, int]:
    """Return the bytes on the ledger by consumer."""
    found: dict[str, int] = {}
    for lease in _on(gpu, status):
        found[lease.consumer] = found.get(lease.consumer, 0) + lease.charge_bytes
    if rest := gpu.charged_bytes - sum(found.values()):
        found[RESIDUES] = rest
    return found


def measured(gpu: GpuView, status: StatusReply) -> Mapping[str, int]:
    """Return measured bytes by consumer; none while the GPU is unknown.

    They add up to the bytes in use, or to more where the driver's list and its total disagree. A
    process with leases of several consumers counts once, under their names joined by "+": its
    bytes cannot be told apart.
    """
    if gpu.measured_used_bytes is None:
        return {}
    consumers = {lease.lease_id: lease.consumer for lease in _on(gpu, status)}
    found: dict[str, int] = {}
    for process in gpu.processes:
        if process.used_bytes is None:
            continue  # the driver lists it and does not say
        names = {consumers[lease] for lease in process.lease_ids if lease in consumers}
        name = "+".join(sorted(names)) or (STOWAWAYS if process.stowaway else RESIDUES)
        found[name] = found.get(name, 0) + process.used_bytes
    if (rest := gpu.measured_used_bytes - sum(found.values())) > 0:
        found[UNATTRIBUTED] = rest
    return found


def oldest_wait_s(status: StatusReply) -> float:
    """Return how long the oldest request has waited; 0: none waits."""
    return max((one.waited_s for one in status.leases if one.state == "queued"), default=0.0)


def _on(gpu: GpuView, status: StatusReply) -> Iterator[LeaseView]:
    return (lease for lease in status.leases if lease.gpu == gpu.gpu and lease.charge_bytes)
