"""A sidecar process for the episodes: a real host, lease and simulated GPU around a model that
looks at nothing and holds the arm still.

`python episode_sidecar.py FOLDER [flags of vram-sidecar]`. While a file `hold` is in FOLDER, a call
of the model does not come back (`holding` says that it is in one); a file `fail_load` or `fail`
makes the load or a call fail, `slow_load` makes the load last.
"""

import functools
import sys
import threading
from pathlib import Path
from typing import Any

from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.__main__ import main as serve
from vram_arbiter.sidecars.weights import Weights

LOOK_S = 0.005


class StillModel:
    modules = ()

    def __init__(self, manifest: RSkillManifest, folder: Path) -> None:
        self.kind: Any = manifest.kind.value
        self.ops = frozenset({"detect"} if self.kind == "detector" else {"get_action", "reset"})
        self._folder = folder

    def _while_there(self, name: str) -> None:
        while (self._folder / name).exists():
            threading.Event().wait(LOOK_S)

    def _fail(self, name: str) -> None:
        if (self._folder / name).exists():
            raise RuntimeError(f"{name} as told")

    def prepare(self) -> None:
        pass

    def load(self, device: str) -> None:
        pass

    networks = ()

    def place(self, device: str) -> None:
        self._while_there("slow_load")
        self._fail("fail_load")

    def run(self, call: Any) -> dict[str, Any]:
        """An answer that moves nothing: where the joints are, for ten steps; or no detection."""
        if not isinstance(call, EndpointCall):
            return {"ok": True, "answer": "", "norm": 1000, "detections": []}
        if call.endpoint == "reset":
            return {}
        (self._folder / "holding").touch()
        self._while_there("hold")
        (self._folder / "holding").unlink(missing_ok=True)
        self._fail("fail")
        import numpy as np

        return {"action": np.tile(call.data["observation"]["observation.state"], (10, 1))}


def still_for(folder: Path, manifest: RSkillManifest, weights: Weights) -> Any:
    return StillModel(manifest, folder)


def main() -> int:
    folder = Path(sys.argv.pop(1))
    return serve(adapter_for=functools.partial(still_for, folder))


if __name__ == "__main__":
    sys.exit(main())
