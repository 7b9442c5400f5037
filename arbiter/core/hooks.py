"""Hooks through which an optional feature takes part in the engine.

The rooms of the engine call the hooks of every registered feature (`Core.features`) and know no feature by name.
A feature owns its records, keyed by lease id; `Arbiter` registers it. Without features the engine is whole.
"""

from collections.abc import Iterable, Mapping
from typing import TYPE_CHECKING, Any, ClassVar

from vram_arbiter.arbiter.core.events import MemorySampled, Spec
from vram_arbiter.arbiter.core.model.lease import Lease

if TYPE_CHECKING:
    from vram_arbiter.arbiter.core.model.state import Core, Gpu
    from vram_arbiter.arbiter.core.report.standing import Standing


class Feature:
    """One optional feature. Each hook does nothing here; a feature overrides the ones that it needs."""

    timers: ClassVar[frozenset[str]] = frozenset()
    """Kinds of timers that are due to this feature."""

    # -- requests --------------------------------------------------------------------------------------------------
    def check_request(self, core: "Core", spec: Spec) -> None:
        """A lease is asked for. Raise Refused to refuse it."""

    def on_refused(self, core: "Core", spec: Spec, why: str) -> None:
        """A request was refused: no GPU can ever hold it."""

    def hold_back(self, core: "Core", request: Lease) -> bool:
        """Keep a new request out of the queues. Return whether it is kept."""
        return False

    def unqueued(self) -> Iterable[Lease]:
        """Return the requests that this feature keeps out of the queues."""
        return ()

    # -- scheduling ------------------------------------------------------------------------------------------------
    def blocks(self, gpu: "Gpu") -> str:
        """Say why this feature keeps a GPU from every other request; "" if it does not."""
        return ""

    def serve_reserved(self, core: "Core", gpu: "Gpu") -> bool:
        """Serve a GPU that this feature keeps from every other request. Return whether it does."""
        return False

    def owns(self, request: Lease) -> bool:
        """Return whether only `serve` grants this request; it is not backfilled."""
        return False

    def serve(self, core: "Core", gpu: "Gpu", head: Lease | None) -> bool:
        """Serve a GPU whose queue has this head, None if it is empty. Return whether the head is this feature's own."""
        return False

    def protects(self, lease: Lease) -> str:
        """Say why a holder must not be revoked for others now; "" if it may be."""
        return ""

    def grant(self, core: "Core", gpu: "Gpu", request: Lease) -> bool:
        """Grant a request that is this feature's own. Return whether it was."""
        return False

    # -- the life of a lease ---------------------------------------------------------------------------------------
    def on_unloading(self, core: "Core", lease: Lease, why: str) -> None:
        """A resident lease begins to unload, is released, expires or is lost. Its state has not changed yet."""

    def on_ended(self, core: "Core", lease: Lease) -> None:
        """A lease or a request is over: drop what is kept of it."""

    def size_changes(self, lease: Lease) -> bool:
        """Return whether the declared size of a resident lease is not to be compared with readings now."""
        return False

    def settle(self, core: "Core") -> None:
        """An event was handled; the GPUs are scheduled next."""

    # -- readings and time -----------------------------------------------------------------------------------------
    def on_sample(self, core: "Core", gpu: "Gpu", sample: MemorySampled) -> None:
        """A reading counts; the ledger and the verifications have taken it."""

    def on_timer(self, core: "Core", kind: str, subject: str) -> None:
        """A timer of one of `timers` is due."""

    # -- the journal -----------------------------------------------------------------------------------------------
    def to_record(self, lease: Lease) -> Mapping[str, Any]:
        """Return what the journal's record of a lease keeps of this feature."""
        return {}

    def from_record(self, core: "Core", lease: Lease, record: Mapping[str, Any]) -> None:
        """A resident lease is restored from its record after a restart."""

    # -- reports ---------------------------------------------------------------------------------------------------
    def view(self, core: "Core", lease: Lease) -> Mapping[str, object]:
        """Return the fields of `schemas.wire.LeaseView` that this feature adds."""
        return {}

    def standing(self, core: "Core", lease: Lease) -> "Standing | None":
        """Tell how a request, or the group of a granted lease, waits; None: as any other."""
        return None

    # -- invariants ------------------------------------------------------------------------------------------------
    def check(self, core: "Core", *, everything: bool) -> None:
        """Raise InvariantViolation if a record that the last event can have changed, or any of them, is unsound."""
