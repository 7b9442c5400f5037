"""Hooks through which an optional feature takes part in the engine.

The rooms of the engine know no feature by name. What concerns one lease goes to the features of
that lease (`Lease.features`: a feature adds itself with `watch`); everything else goes to the
registered features that override the hook (`Core.hooked`). A plain lease costs no call.
A feature owns its records, keyed by lease id. Without features the engine is whole.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    LeaseSpec,
    MemorySampled,
    ReattachedLease,
    ReleaseReported,
)
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.refusals import End
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.errors import Refusal

if TYPE_CHECKING:
    from vram_arbiter.arbiter.core.model.state import Core, Gpu
    from vram_arbiter.arbiter.core.report.standing import Standing


HOOKS = (
    "on_acquire",
    "on_refused",
    "on_request",
    "unplaced",
    "serve",
    "settle",
    "on_sample",
    "from_record",
    "on_reattached",
    "check",
)
"""Hooks that concern no lease, or one that no feature watches yet."""


class Feature:
    """One optional feature. Each hook does nothing here; a feature overrides what it needs."""

    timers: ClassVar[frozenset[str]] = frozenset()
    """Kinds of timers that are due to this feature."""

    def watch(self, lease: Lease) -> None:
        """Take part in what concerns a lease from now on."""
        if not any(feature is self for feature in lease.features):
            lease.features = (*lease.features, self)

    # -- requests
    def on_acquire(self, core: "Core", event: AcquireRequested, known: Lease | None) -> bool:
        """A lease is acquired. Return whether this feature answers. May raise Refused.

        `known`: the lease, if this acquire is a repeat.
        """
        return False

    def on_refused(self, core: "Core", spec: LeaseSpec, refusal: Refusal) -> None:
        """A request was refused: no GPU can ever hold it."""

    def on_request(self, core: "Core", request: Lease) -> bool:
        """Watch a new request. Return whether this feature keeps it out of the queues."""
        return False

    def unplaced(self) -> Iterable[Lease]:
        """Return the leases of this feature that are on no GPU and in no queue."""
        return ()

    def on_release(self, core: "Core", event: ReleaseReported, lease: Lease) -> None:
        """A resident lease is about to be released. May raise Refused.

        If it is to be parked, every feature is asked.
        """

    def give_up(self, core: "Core", lease: Lease, to: LeaseState, refusal: End) -> bool:
        """End a lease that would outlive its release. Return whether it was one.

        Its holder is gone, or does not want it any more.
        """
        return False

    def on_dismissed(self, core: "Core", lease: Lease, order: Order) -> None:
        """An operator evicted a lease."""

    # -- scheduling
    def blocks(self, gpu: "Gpu") -> str:
        """Return the name of the group that this feature keeps a GPU for (`Gpu.keeper`)."""
        return ""

    def owns(self, request: Lease) -> bool:
        """Return whether a request is granted by `serve` alone."""
        return False

    def serve(self, core: "Core", gpu: "Gpu", head: Lease | None) -> None:
        """Serve a GPU that this feature keeps, whose head it owns, or that has no head."""

    def grant(self, core: "Core", gpu: "Gpu", request: Lease) -> bool:
        """Grant a request in this feature's own way. Return whether it was granted."""
        return False

    def protects(self, lease: Lease) -> str:
        """Return the name of the group that keeps a holder from being revoked for others; "" if
        none does."""
        return ""

    def unclaimed(self, lease: Lease) -> bool:
        """Return whether a resident has no minimum residency."""
        return False

    def can_park(self, lease: Lease) -> bool:
        """Return whether a revoked holder may keep its weights in host RAM."""
        return False

    # -- the life of a lease
    def on_moved(self, core: "Core", lease: Lease, before: LeaseState) -> None:
        """A lease came to another state."""

    def on_used(self, lease: Lease) -> None:
        """A use of a lease begins."""

    def next_state(self, lease: Lease) -> LeaseState | None:
        """Return where a released lease goes after its verdict; None: it is over then."""
        return None

    def size_changes(self, lease: Lease) -> bool:
        """Return whether readings cannot be compared with the declared size of a resident now."""
        return False

    # -- readings and time
    def settle(self, core: "Core") -> None:
        """An event was handled; the GPUs are scheduled next."""

    def on_sample(self, core: "Core", gpu: "Gpu", sample: MemorySampled) -> None:
        """A reading counts; the ledger and the verifications have taken it."""

    def on_timer(self, core: "Core", kind: str, subject: str) -> None:
        """A timer of one of `timers` is due."""

    # -- across a restart
    def to_record(self, lease: Lease) -> Mapping[str, Any]:
        """Return what the journal's record of a lease keeps of this feature."""
        return {}

    def from_record(self, core: "Core", lease: Lease, record: Mapping[str, Any]) -> None:
        """A lease was restored from its record."""

    def on_reattached(self, core: "Core", lease: Lease, item: ReattachedLease) -> None:
        """A holder reattached, and says how it knows its lease. The journal may not know it."""

    # -- reports and invariants
    def view(self, core: "Core", lease: Lease) -> Mapping[str, object]:
        """Return the fields of `schemas.wire.LeaseView` that this feature adds."""
        return {}

    def standing(self, core: "Core", lease: Lease) -> "Standing | None":
        """Tell how a request, or the group of a granted lease, waits; None: as any other."""
        return None

    def check(self, core: "Core", *, everything: bool) -> None:
        """Raise InvariantViolation if a record is unsound that the last event can have changed.

        `everything`: if any record is.
        """


def overriding(features: Iterable[Feature], hook: str) -> tuple[Feature, ...]:
    """Return the features that override a hook."""
    default = getattr(Feature, hook)
    return tuple(feature for feature in features if getattr(type(feature), hook) is not default)


def owner_of(request: Lease) -> Feature | None:
    """Return the feature that alone grants a request."""
    return next((feature for feature in request.features if feature.owns(request)), None)
