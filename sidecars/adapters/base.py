"""Interface of a model: prepare, load, run, unload.

An adapter knows its model and nothing of leases, sockets or bytes.
"""

from typing import Literal, Protocol

from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.sidecar import DetectOp, EndpointCall, QueryOp, ScoreOp

ModelCall = DetectOp | QueryOp | ScoreOp | EndpointCall


class ModelAdapter(Protocol):
    """One model. All methods block, and run in the model's own process, one at a time.

    `ops` are the ops or endpoints that `run` answers. `prepare` does what needs no device (imports,
    processors). `load` puts the weights onto `device` (`cpu`, `cuda:0`) and `unload` drops every
    reference to them; both may be repeated. A load onto `meta` allocates nothing: it finds out
    whether the checkpoint holds the whole model, as every load does. `run` raises a
    `schemas.errors` type for the caller's mistakes; anything else that it raises is the model's own
    failure.
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

    def load(self, device: str) -> None: ...

    def run(self, call: ModelCall) -> Message: ...
