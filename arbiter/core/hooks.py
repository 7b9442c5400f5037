"""Hooks through which an optional feature takes part in the engine.

The rooms of the engine know no feature by name. A feature owns its records, keyed by lease id:
  - its requests and timers go to its own methods (`arbiter`)
  - what concerns one lease goes to the features of that lease (`Lease.features`, by `watch`)
  - a GPU without waiters and the invariants concern it while its table `live` is not empty
A plain lease costs no call. Without features the engine is whole.
"""

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

from vram_arbiter.arbiter.core.events import ReattachedLease, ReleaseReported
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.arbiter.core.model.refusals import End
from vram_arbiter.schemas.wire.codes import Order
from vram_arbiter.schemas.wire.views import LeaseView

if TYPE_CHECKING:
    from vram_arbiter.arbiter.core.model.gpu import Gpu
    from vram_arbiter.arbiter.core.model.state import Core
    from vram_arbiter.arbiter.core.report.why import Standing


class Feature:
    """One optional feature. Each hook does nothing here; a feature overrides what it needs."""

    live: Mapping[Any, object] = {}
    """What the feature follows now."""

    def watch(self, lease: Lease) -> None:
        """Take part in what concerns a lease from now on."""
        if not any(feature is self for feature in lease.features):
            lease.features = (*lease.features, self)

    # -- scheduling
    def serve(self, core: "Core", gpu: "Gpu", group: "Group") -> None:
        """Serve a group of this feature: it loads on a GPU, or its request is the head there."""

    def on_idle(self, core: "Core", gpu: "Gpu") -> None:
        """Nothing waits for a GPU."""

    def grant(self, core: "Core", gpu: "Gpu", request: Lease) -> bool:
        """Grant a request in this feature's own way. Return whether it was granted."""
        return False

    def can_park(self, lease: Lease) -> bool:
        """Return whether a revoked holder may keep its weights in host RAM."""
        return False

    # -- the life of a lease
    def on_moved(self, core: "Core", lease: Lease, before: LeaseState) -> None:
        """A lease came to another state."""

    def on_release(self, core: "Core", event: ReleaseReported, lease: Lease) -> None:
        """A resident lease is about to be released. May raise Refused.

        If it is to be parked, every feature is asked.
        """

    def next_state(self, lease: Lease) -> LeaseState | None:
        """Return where a released lease goes after its verdict; None: it is over then."""
        return None

    def give_up(self, core: "Core", lease: Lease, to: LeaseState, refusal: End) -> bool:
        """End a lease that would outlive its release. Return whether it was one.

        Its holder is gone, or does not want it any more.
        """
        return False

    def on_dismissed(self, core: "Core", lease: Lease, order: Order) -> None:
        """An operator evicted a lease."""

    # -- across a restart
    def to_record(self, lease: Lease, record: LeaseRecord) -> LeaseRecord:
        """Return the journal's record of a lease with what it keeps of this feature."""
        return record

    def from_record(self, core: "Core", lease: Lease, record: LeaseRecord) -> None:
        """A lease was restored from its record. Every feature is asked."""

    def on_reattached(self, core: "Core", lease: Lease, item: ReattachedLease) -> None:
        """A holder reattached, and says how it knows its lease. The journal may not know it.

        Every feature is asked.
        """

    # -- reports and invariants
    def view(self, shown: LeaseView, lease: Lease) -> LeaseView:
        """Return how a lease is shown, with what this feature adds."""
        return shown

    def standing(self, core: "Core", lease: Lease) -> "Standing | None":
        """Tell how a request, or the group of a granted lease, waits; None: as any other."""
        return None

    def check(self, core: "Core") -> None:
        """Raise InvariantViolation if a record is unsound that the last event can have changed."""


@dataclass(slots=True)
class Group:
    """Requests that a feature grants together: it alone serves them, and the GPU they load on."""

    name: str
    feature: Feature = field(repr=False, compare=False)
