"""A whole sidecar process around a model without weights: `python echo_sidecar.py FOLDER [flags of
vram-sidecar]`.

FOLDER tells it what to do: a file `fail_prepare` or `fail_load` makes that step fail,
`slow_prepare` or `slow_load` makes it last; a module `endless.py` is imported. The query tells
`run`: `hold NAME` waits until the file NAME appears there, `fail` raises; anything else is
echoed. `query` is answered with what stands behind the picture's first eight bytes.
"""

import functools
import sys
import threading
from pathlib import Path

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.schemas.sidecar import QueryOp
from vram_arbiter.sidecars.__main__ import main as serve


class EchoAdapter:
    kind = "detector"
    ops = frozenset({"detect", "query", "get_action", "reset"})

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self.modules = ("endless",) if (folder / "endless.py").exists() else ()
        self._model: str | None = None

    def _fail(self, step: str) -> None:
        if (self._folder / f"fail_{step}").exists():
            raise RuntimeError(f"{step} fails as told")

    def _last(self, step: str) -> None:
        while (self._folder / f"slow_{step}").exists():
            threading.Event().wait(0.005)

    def prepare(self) -> None:
        self._last("prepare")
        self._fail("prepare")

    def load(self, device: str) -> None:
        self._fail("read")

    networks = ()

    def place(self, device: str) -> None:
        self._last("load")
        self._fail("load")
        self._model = device

    def run(self, call) -> dict[str, object]:
        if self._model is None:
            raise RuntimeError("run without a model")
        if isinstance(call, QueryOp):
            return {"ok": True, "answer": call.image[8:].decode()}
        query = getattr(call, "query", "get_action")
        if query == "fail":
            raise RuntimeError("the model fails as told")
        if query == "refuse":
            raise BadRequest("not like that")
        if query.startswith("hold "):
            (self._folder / "holding").touch()
            while not (self._folder / query.removeprefix("hold ")).exists():
                threading.Event().wait(0.005)
            (self._folder / "holding").unlink()
        return {"ok": True, "answer": query, "norm": 1000, "detections": []}


def echo_for(folder: Path, manifest, weights) -> EchoAdapter:
    return EchoAdapter(folder)


def main() -> int:
    folder = Path(sys.argv.pop(1))
    return serve(adapter_for=functools.partial(echo_for, folder))


if __name__ == "__main__":
    sys.exit(main())
