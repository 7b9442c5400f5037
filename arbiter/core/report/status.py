"""Views of leases and GPUs, pages of `status`, and the record of a switch.

Typed data without words. Reads only. `view` is made for every reply about a lease.
"""

from collections.abc import Iterator, Mapping
from dataclasses import replace
from functools import partial
from heapq import merge, nsmallest
from itertools import islice
from math import inf

from vram_arbiter.arbiter.core import learning
from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.lease import AWAY, EXPIRING, Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.notes import EvictedLease, SwitchNote
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import (
    BlockView,
    GpuView,
    HostRamView,
    LeaseView,
    ProcessView,
    Totals,
)

MISSING_NAMED = 3
"""Holders that have not reattached and are named; the others are counted."""

type PageKey = tuple[int, float, int]
"""Where `status` goes on: waiters (1) after all others (0), rank in the queues, arrival."""

FIRST_PAGE: PageKey = (0, 0.0, 0)


# -- views
def view(core: Core, lease: Lease) -> LeaseView:
    """Return a lease as its holder or an operator may see it."""
    request, queued = lease.request, lease.state is LeaseState.QUEUED
    charge_bytes = 0 if lease.state in AWAY else request.load_peak_bytes  # that will be charged
    drift_bytes, ttl_left_s = 0, None
    if lease.gpu is not None:
        charge_bytes = core.gpus[lease.gpu].ledger.charge_bytes(lease.id)
        if lease.state in EXPIRING:
            ttl_left_s = max(0.0, lease.expires_at - core.now)
        if lease.state is not LeaseState.LOADING:
            drift_bytes = learning.drift_bytes(core.gpus, lease)
    return LeaseView(
        lease_id=lease.id,
        token=lease.token,
        state=lease.state,
        consumer=lease.spec.consumer,
        model=lease.spec.model,
        gpu=lease.gpu,
        mode=lease.spec.mode,
        priority=lease.spec.priority,
        evictable=lease.evictable,
        charge_bytes=charge_bytes,
        uses=len(lease.uses),
        pid=lease.process.pid,
        since_s=core.now - lease.since,
        waited_s=(core.now if queued else lease.granted_at) - request.arrived_at,
        granted_s=None if lease.token is None else core.now - lease.held_from,
        position=position(core.gpus, lease) if queued else None,
        ttl_left_s=ttl_left_s,
        pinned="" if lease.pinned is None else str(lease.pinned),
        drift_bytes=drift_bytes,
        standby=lease.spec.standby,
        parked_bytes=core.host_ram.booked.get(lease.id),
    )


def position(gpus: Mapping[GpuId, Gpu], lease: Lease) -> int:
    """Return the best place of a request in a queue."""
    return min([gpus[gpu_id].queue.position(lease) for gpu_id in lease.request.gpus])


def gpu_view(gpu: Gpu, block: BlockView | None, now: float) -> GpuView:
    """A GPU: what is charged, measured and blocked."""
    ledger = gpu.ledger
    sample, known = gpu.sample, gpu.failed_at is None
    return GpuView(
        gpu=gpu.info.id,
        index=gpu.info.index,
        name=gpu.info.name,
        source=gpu.info.source,
        capacity_bytes=gpu.info.capacity_bytes,
        reserve_bytes=gpu.info.reserve_bytes,
        charged_bytes=ledger.charged_bytes,
        stowaway_bytes=ledger.stowaway_bytes,
        measured_used_bytes=sample.used_bytes if known and sample is not None else None,
        sample_age_s=None if sample is None else now - sample.taken_at,
        pressure_bytes=ledger.pressure_bytes(),
        blocked=block,
        processes=tuple(_processes(gpu)),
    )


def block_view(core: Core, gpu: Gpu) -> BlockView | None:
    """Why nothing is granted on a GPU now, with its values; None if grants are possible."""
    code = core.blocked(gpu) or gpu.blocked
    match code:
        case None:
            return None
        case Block.RECOVERING:
            missing = core.recovering
            known = [core.leases[one] for one in sorted(missing) if one in core.leases]
            names = tuple(f"{one.spec.consumer} (pid {one.process.pid})" for one in known)
            return BlockView(code, names[:MISSING_NAMED], more=len(names[MISSING_NAMED:]))
        case Block.DRAINED:
            return BlockView(code, problem=str(core.drain))
        case Block.UNREADABLE:
            return BlockView(code, problem=gpu.failure)
        case Block.LOADING:
            loading = gpu.in_state(LeaseState.LOADING)[:1]
            return BlockView(code, tuple(one.spec.consumer for one in loading))
        case Block.PRESSURE:
            return BlockView(code, bytes=gpu.ledger.pressure_bytes())
        case _:
            return BlockView(code)


def _processes(gpu: Gpu) -> Iterator[ProcessView]:
    listed: dict[int, ProcessUse] = {}
    if gpu.sample is not None:
        listed = {use.process.pid: use for use in gpu.sample.processes or ()}
    for account in gpu.ledger.accounts.values():
        use = listed.get(account.process.pid)
        yield ProcessView(
            pid=account.process.pid,
            name="" if use is None else use.name,
            used_bytes=None if use is None else use.used_bytes,
            lease_ids=tuple(sorted(account.charges)),
            charged_bytes=account.charged_bytes,
            residue_bytes=account.retained_bytes,
            stowaway=False,
        )
    for stowaway in gpu.ledger.stowaways.values():
        pid, used = stowaway.process.pid, stowaway.held_bytes
        yield ProcessView(pid, stowaway.name, used, (), 0, 0, stowaway=True)


def status(
    core: Core,
    reader: ProcessKey | None = None,
    after: PageKey | None = None,
    limit: int | None = None,
) -> StatusReply:
    """Return the status with the leases that follow `after`, at most `limit` of them.

    A page costs what it holds, however many wait: the queues are sorted already. Tokens are shown
    to `reader`, the process that holds the lease, and to an operator (None): a token is all that is
    needed to mark a use, which keeps a lease from being evicted.
    """
    leases = list(islice(_listed(core.leases, core.gpus, after or FIRST_PAGE, limit), limit))
    more = leases and len(leases) == limit
    return StatusReply(
        epoch=core.settings.epoch,
        phase="serving" if core.serving else "recovering",
        uptime_s=core.now - core.started_at,
        gpus=tuple(gpu_view(gpu, block_view(core, gpu), core.now) for gpu in core.gpus.values()),
        leases=tuple(
            shown if reader in (None, lease.process) else replace(shown, token=None)
            for lease in leases
            for shown in [view(core, lease)]
        ),
        totals=Totals(leases=len(core.leases), waiting=len(core.waiting)),
        clients=len(core.clients),
        host_ram=HostRamView(core.host_ram.budget_bytes, core.host_ram.taken_bytes()),
        drained="" if core.drain is None else str(core.drain),
        problems=(),
        next=_page_key(core.gpus, leases[-1]) if more else None,
    )


def _page_key(gpus: Mapping[GpuId, Gpu], lease: Lease) -> PageKey:
    if lease.state is not LeaseState.QUEUED:
        return (0, 0.0, lease.request.arrival)
    return (1, *gpus[lease.request.gpus[0]].queue.rank(lease))


def _listed(
    leases: Mapping[LeaseId, Lease],
    gpus: Mapping[GpuId, Gpu],
    after: PageKey,
    limit: int | None,
) -> Iterator[Lease]:
    """Yield leases with bytes or away by arrival, then the waiters in the order of the queues.

    Each once.
    """
    key = partial(_page_key, gpus)
    if after[0] == 0:
        granted = [one for one in leases.values() if one.state is not LeaseState.QUEUED]
        rest = [one for one in granted if key(one) > after]
        yield from nsmallest(len(rest) if limit is None else limit, rest, key=key)
    rank = after[1:] if after[0] else (-inf, 0)
    queued = [gpu.queue.after(rank) for gpu in gpus.values()]
    last: Lease | None = None
    for lease in merge(*queued, key=key):
        if lease is not last:  # else it waits for several GPUs
            yield lease
        last = lease


# -- switch
def switch_record(lease: Lease, now: float) -> SwitchNote:
    """Milliseconds of a grant from the acquire to `ready`, split by phase; of several victims the
    slowest counts."""
    gone = lease.request.evicted
    first_asked = min((e.asked_at for e in gone), default=lease.granted_at)
    return SwitchNote(
        switched=bool(gone),
        evicted=tuple(EvictedLease(e.consumer, e.lease, e.verdict, e.charge_bytes) for e in gone),
        verified=all(e.verdict == "verified" for e in gone),
        wait_ms=max(0.0, first_asked - lease.request.arrived_at) * 1e3,
        drain_ms=max((_span(e.asked_at, e.unloading_at) for e in gone), default=0.0),
        unload_ms=max((_span(e.unloading_at, e.released_at) for e in gone), default=0.0),
        verify_ms=max((_span(e.released_at, e.verdict_at) for e in gone), default=0.0),
        load_ms=(now - lease.granted_at) * 1e3,
        total_ms=(now - lease.request.arrived_at) * 1e3,
    )


def _span(start: float | None, end: float | None) -> float:
    return 0.0 if start is None or end is None else max(0.0, end - start) * 1e3
