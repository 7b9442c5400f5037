"""Interface of a model: prepare, load, place, run.

An adapter knows its model and nothing of leases, sockets or bytes.
"""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, Literal, Protocol

from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import DetectOp, EndpointCall, QueryOp, ScoreOp

if TYPE_CHECKING:
    from torch.nn import Module

LEROBOT = "vram_arbiter.sidecars.preload_lerobot"
DIFFUSERS = "vram_arbiter.sidecars.preload_diffusers"
PEFT = "vram_arbiter.sidecars.preload_peft"
"""Modules of lerobot's policies, for `ModelAdapter.modules`."""
type Inputs = Mapping[str, Any]
"""Inputs of a model by name: tensors, texts."""
ModelCall = DetectOp | QueryOp | ScoreOp | EndpointCall


def has_model(manifest: RSkillManifest) -> bool:
    """Return whether a manifest is served by a model: `policy_extras.adapter` names code that is
    none.
    """
    return "adapter" not in manifest.policy_extras


class ModelAdapter(Protocol):
    """One model. All methods block, and are called one at a time.

    `ops` are the ops or endpoints that `run` answers. `prepare` does what needs no weights
    (imports, processors). `load` reads the weights into host RAM (`cpu`), in the precision in which
    they run: cast, quantized and complete, or ModelError. A load onto `meta` allocates nothing: it
    finds out whether the checkpoint holds the whole model, as every load does. `networks` are what
    was loaded. `place` puts them onto `device` (`cpu`, `cuda:0`), in a process forked from the one
    that loaded, and only there `run` is called. `run` raises a `schemas.errors` type for the
    caller's mistakes; anything else that it raises is the model's own failure.
    """

    @property
    def kind(self) -> Literal["detector", "vlm", "vla", "reward"]: ...

    @property
    def ops(self) -> frozenset[str]: ...

    @property
    def modules(self) -> tuple[str, ...]:
        """Modules that take long to import, for the server of model processes (`preload`)."""
        ...

    def prepare(self) -> None: ...

    def load(self, device: Literal["cpu", "meta"]) -> None: ...

    @property
    def networks(self) -> "Sequence[Module]":
        """Networks whose parameters and buffers are the model's weights."""
        ...

    def place(self, device: str) -> None: ...

    def run(self, call: ModelCall) -> Message: ...


class OneNetwork:
    """Part of an adapter whose model is one network that only has to be moved."""

    _model: Any = None

    @property
    def networks(self) -> "Sequence[Module]":
        return (self._model,)

    def place(self, device: str) -> None:
        self._model.to(device)
