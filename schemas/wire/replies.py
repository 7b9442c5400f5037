"""Answers to requests: `{"re": n, "epoch": e, "ok": true, …}`, one class per shape. Standard
library only."""

from dataclasses import dataclass
from typing import Literal

from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.explained import LeaseDetail
from vram_arbiter.schemas.wire.tagged import AnyReply as AnyReply
from vram_arbiter.schemas.wire.views import (
    DaemonView,
    DemandView,
    GpuView,
    HostRamView,
    LeaseView,
    Totals,
)


class DoneReply(AnyReply):
    """Done, with nothing to say: `subscribe`, `bye`."""


class WelcomeReply(AnyReply):
    """Answer to `hello`."""

    version: int
    boot_id: str
    server: str
    role: str
    heartbeat_s: float
    grace_s: float


class PingReply(AnyReply):
    server: str


class AcquireReply(AnyReply):
    """Answer to `acquire` and `reacquire`: `loading` or `queued`."""

    state: str
    lease: LeaseView


class ReadyReply(AnyReply):
    lease: LeaseView


class UsesReply(AnyReply):
    """Answer to `use_begin` and `use_end`: busy uses of the lease."""

    uses: int


class StateReply(AnyReply):
    """Answer to `revoke_ack`, `unloading` and `cancel`."""

    state: str
    uses: int | None = None


class ReleaseReply(AnyReply):
    """`next`: what the lease becomes once its bytes are measured gone: `released`, `standby` or
    `parked`."""

    state: str
    next: str


@dataclass(frozen=True, slots=True)
class GoneLease:
    lease_id: str
    error: ErrorView


class RenewReply(AnyReply):
    alive: tuple[str, ...]
    gone: tuple[GoneLease, ...]


@dataclass(frozen=True, slots=True)
class ReattachedView:
    """Verdict on one lease that a client named: `kept`, or `error` says why not."""

    lease_id: str
    kept: bool
    lease: LeaseView | None = None
    error: ErrorView | None = None


class ReattachReply(AnyReply):
    leases: tuple[ReattachedView, ...]


class OomReply(AnyReply):
    """`learnt_load_peak_bytes`: the footprint from now on; None: it was not the footprint."""

    learnt_load_peak_bytes: int | None


class StatusReply(AnyReply):
    """The state of everything. `leases` is a page of the live ones: held, loading, …, then the
    queue in order."""

    epoch: int
    phase: Literal["recovering", "serving"]
    uptime_s: float
    gpus: tuple[GpuView, ...]
    leases: tuple[LeaseView, ...]
    totals: Totals
    clients: int
    host_ram: HostRamView
    drained: str  # the operator that drained the arbiter, and why; "" while it grants
    problems: tuple[str, ...]  # what is wrong with the daemon's own files, in words
    next: tuple[int, float, int] | None = None  # there may be more: ask again with this as `after`
    details: tuple[LeaseDetail, ...] = ()  # of each lease of the page, where they are asked for
    daemon: DaemonView | None = None
    demands: tuple[DemandView, ...] = ()  # on the first page


class HistoryReply(AnyReply):
    """Events after a number, oldest first. `problem`: why older ones cannot be read, in words.

    `numbering` names the history that the numbers belong to. Another name: the numbers began again.
    """

    events: tuple[JsonMap, ...]
    last_seq: int
    problem: str = ""
    numbering: str = ""


class OperatorReply(AnyReply):
    """Answer to `evict`, `kill`, `pin`, `unpin` and `release_dead`; `lease` is None when it is
    over."""

    state: str
    lease: LeaseView | None = None


class DrainReply(AnyReply):
    """Answer to `drain` and `resume`: the operator that drained the arbiter, and why; "" while it
    grants."""

    drained: str


class PrepareReply(AnyReply):
    """`told`: sessions of the consumer that the hint went to."""

    told: int
