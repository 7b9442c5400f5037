"""Hooks through which an optional feature takes part in the engine.

The rooms of the engine call the hooks of every registered feature (`Core.features`) and know no feature by name.
A feature owns its records, keyed by lease id; `Arbiter` registers it. Without features the engine is whole.
"""

from collections.abc import Mapping
from typing import TYPE_CHECKING, ClassVar

from vram_arbiter.arbiter.core.events import MemorySampled
from vram_arbiter.arbiter.core.model.lease import Lease

if TYPE_CHECKING:
    from vram_arbiter.arbiter.core.model.state import Core, Gpu


class Feature:
    """One optional feature. Each hook does nothing here; a feature overrides the ones that it needs."""

    timers: ClassVar[frozenset[str]] = frozenset()
    """Kinds of timers that are due to this feature."""

    # -- grants ----------------------------------------------------------------------------------------------------
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

    # -- readings and time -----------------------------------------------------------------------------------------
    def on_sample(self, core: "Core", gpu: "Gpu", sample: MemorySampled) -> None:
        """A reading counts; the ledger and the verifications have taken it."""

    def on_timer(self, core: "Core", kind: str, subject: str) -> None:
        """A timer of one of `timers` is due."""

    # -- reports ---------------------------------------------------------------------------------------------------
    def view(self, core: "Core", lease: Lease) -> Mapping[str, object]:
        """Return the fields of `schemas.wire.LeaseView` that this feature adds."""
        return {}
