"""A model of one matrix, as large as a test wants it, for what happens to weights."""

from collections.abc import Sequence
from typing import Any

from vram_arbiter.schemas.plain import Message

ROW = 1024


class MatrixModel:
    """The op `detect`: the mean of the weights as the answer, computed on the device."""

    kind: Any = "detector"
    ops = frozenset({"detect"})
    modules = ("torch",)

    def __init__(self, weights_bytes: int) -> None:
        self._rows = weights_bytes // (4 * ROW)
        self._network: Any = None

    def prepare(self) -> None:
        pass

    def load(self, device: str) -> None:
        import torch

        torch.manual_seed(0)
        self._network = torch.nn.Linear(ROW, self._rows, bias=False)

    @property
    def networks(self) -> Sequence[Any]:
        return () if self._network is None else (self._network,)

    def place(self, device: str) -> None:
        self._network.to(device)

    def run(self, call: Any) -> Message:
        mean = self._network.weight.detach().double().mean()
        return {"ok": True, "answer": f"{float(mean):.18f}", "norm": 1000, "detections": []}


def matrix_for(weights_bytes: int, manifest: Any, weights: Any) -> MatrixModel:
    return MatrixModel(weights_bytes)
