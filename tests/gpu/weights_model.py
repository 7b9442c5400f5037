"""Random weights behind a sidecar: `python weights_model.py BYTES [flags of vram-sidecar]`.

The op `detect` answers with a figure that depends on every weight, computed on the device; for the
query `reference` with that of the same weights on the CPU, for `copies` with the seconds that
copying the weights took, for `hold PATH` once that file exists (`PATH.held` says that it waits).
"""

import functools
import json
import statistics
import sys
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.sidecars.__main__ import main as serve
from vram_arbiter.sidecars.quantization import quantize_linear

WIDTH = 1024
LAYER_BYTES = WIDTH * 4 * WIDTH * 4 * 2
REPEATS = 5


class WeightsModel:
    """Blocks of two linear layers in float32 or, as the manifest says, in NF4."""

    kind: Any = "detector"
    ops = frozenset({"detect"})
    modules = ("torch",)

    def __init__(self, weights_bytes: int, manifest: RSkillManifest) -> None:
        self._blocks = max(1, weights_bytes // LAYER_BYTES)
        self._manifest = manifest
        self._network: Any = None
        self._device = "cpu"
        self._copy_s = 0.0

    def prepare(self) -> None:
        import torch  # noqa: F401  its import time belongs here

    def load(self, device: str) -> None:
        import torch
        from torch import nn

        torch.manual_seed(0)
        wide = 4 * WIDTH
        blocks = [
            nn.Sequential(nn.Linear(WIDTH, wide, bias=False), nn.Linear(wide, WIDTH, bias=False))
            for _ in range(self._blocks)
        ]
        self._network = nn.Sequential(*blocks).eval().requires_grad_(False)
        quantize_linear(self._network, self._manifest)

    @property
    def networks(self) -> Sequence[Any]:
        return () if self._network is None else (self._network,)

    def place(self, device: str) -> None:
        self._device = device
        self._copy_s = self._timed(lambda: self._network.to(device))

    def run(self, call: Any) -> Message:
        match call.query:
            case "copies":
                answer = json.dumps(self._copies())
            case str(query) if query.startswith("hold "):
                answer = self._held(Path(query.removeprefix("hold ")))
            case "reference":
                answer = f"{self._reference():.9e}"
            case _:
                answer = f"{self._figure():.9e}"
        return {"ok": True, "answer": answer, "norm": 1000, "detections": []}

    def _held(self, go: Path) -> str:
        go.with_suffix(".held").touch()
        while not go.exists():
            threading.Event().wait(0.005)
        return f"{self._figure():.9e}"

    def _reference(self) -> float:
        other = WeightsModel(self._blocks * LAYER_BYTES, self._manifest)
        other.load("cpu")
        return other._figure()

    def _figure(self) -> float:
        import torch

        with torch.inference_mode():
            x = torch.ones(1, WIDTH, device=self._device)
            for block in self._network:
                x = x + block(x)
        return float(x.double().norm())

    def _copies(self) -> dict[str, float]:
        """Time copies of the same number of bytes, from memory of this process alone."""
        import torch

        size = sum(part.numel() * part.element_size() for part in self._network.parameters())
        plain = torch.ones(size, dtype=torch.uint8)
        found = {"bytes": size, "restore_s": self._copy_s, "plain_s": self._median(plain)}
        if self._device != "cpu":
            found["pinned_s"] = self._median(plain.pin_memory())
        return found

    def _median(self, memory: Any) -> float:
        there = memory.to(self._device, copy=True)  # the allocator has room from here on
        return statistics.median(self._timed(lambda: there.copy_(memory)) for _ in range(REPEATS))

    def _timed(self, work: Callable[[], object]) -> float:
        import torch

        def finish() -> None:
            if self._device != "cpu":
                torch.cuda.synchronize()

        finish()
        began_s = time.perf_counter()
        work()
        finish()
        return time.perf_counter() - began_s


def weights_for(weights_bytes: int, manifest: RSkillManifest, weights: Any) -> WeightsModel:
    return WeightsModel(weights_bytes, manifest)


def main() -> int:
    weights_bytes = int(sys.argv.pop(1))
    return serve(adapter_for=functools.partial(weights_for, weights_bytes))


if __name__ == "__main__":
    sys.exit(main())
