"""Detection of a fixed vocabulary by exported models (RT-DETR and its like) through ONNX Runtime.

The manifest's `labels` are the classes, in the model's order. Pictures are resized to `input_size`,
RGB in 0..1. Two answers are read, by the names of the outputs: `logits` and `pred_boxes` (exported
from transformers), or `labels`, `boxes` and `scores` (RT-DETR's own exporter).
"""

import re
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final, Literal

from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.manifest.vocabulary import Dtype, Runtime
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.adapters.detector import detected, detection, split_query
from vram_arbiter.sidecars.images import decode
from vram_arbiter.sidecars.weights import ONNX_FILES, Weights, fetched, fitting

if TYPE_CHECKING:
    from numpy.typing import NDArray

CPU: Final = "CPUExecutionProvider"
CUDA: Final = "CUDAExecutionProvider"
TENSORRT: Final = "TensorrtExecutionProvider"
# without them CUDA's arena doubles with each growth, and cuDNN tries algorithms in spare memory
CUDA_OPTIONS: Final = {
    "arena_extend_strategy": "kSameAsRequested",
    "cudnn_conv_algo_search": "HEURISTIC",
}
FILES: Final[Mapping[Dtype, str]] = {
    Dtype.FP32: "model.onnx",
    Dtype.FP16: "model_fp16.onnx",
    Dtype.INT8: "model_int8.onnx",
}
"""The file of a number format where a repository has several, as exporters name them."""
SIZES: Final = "orig_target_sizes"
"""Input: width and height of the whole picture."""

type Provider = tuple[str, dict[str, str]]
"""Name and options."""
type Outputs = Mapping[str, NDArray[Any]]
"""Arrays by the names of the outputs."""
type Found = tuple[Any, Any]
"""Scores (boxes, classes) and boxes (boxes, 4: x0, y0, x1, y1 in pixels of the whole picture)."""


class OnnxDetectorAdapter:
    """The op `detect` for the classes of the manifest; others are refused, not "not seen"."""

    kind: Literal["detector"] = "detector"
    ops = frozenset({"detect"})
    modules = ("numpy", "PIL.Image", "vram_arbiter.sidecars.onnx_runtime")
    networks = ()

    def __init__(self, manifest: RSkillManifest, weights: Weights) -> None:
        assert manifest.detector is not None, "the kind requires the block"
        self._manifest = manifest
        self._contract = manifest.detector
        self._weights = weights
        self._file = Path()
        self._session: Any = None

    def prepare(self) -> None:
        import vram_arbiter.sidecars.onnx_runtime  # noqa: F401  its import time belongs here

    def load(self, device: str) -> None:
        """Read the whole file once, on the CPU. Raises ModelError for a model of another form."""
        self._weights = fetched(self._weights, ONNX_FILES)
        self._file = _file(Path(self._weights.source), self._manifest.quantization.dtype)
        with fitting(OnnxDetectorAdapter, self._weights):
            session = self._open([(CPU, {})], threads=1)
        self._check(session)

    def place(self, device: str) -> None:
        wanted = providers(self._manifest, device)
        self._session = self._open(wanted)
        if (got := self._session.get_providers()[0]) != wanted[0][0]:  # it falls back and warns
            raise ModelError(
                f"onnxruntime runs the model by {got} instead of {wanted[0][0]}",
                hint="its log says which library of CUDA or TensorRT is missing",
            )

    def run(self, call: ModelCall) -> Message:
        assert isinstance(call, DetectOp)
        asked = self._asked(split_query(call.query))
        picture = decode(call.image)
        threshold = (
            self._contract.score_threshold if call.score_threshold is None else call.score_threshold
        )
        scores, boxes = self._infer(picture)
        found = [
            detection(text, float(scores[box, number]), boxes[box].tolist(), picture.size[::-1])
            for number, text in asked.items()
            for box in (scores[:, number] > threshold).nonzero()[0]
        ]
        return detected([one for one in found if one is not None], picture.size)

    def _infer(self, picture: Any) -> Found:
        """Return what the model finds."""
        import numpy as np
        from PIL import Image

        shrunk = picture.resize(self._contract.input_size, Image.Resampling.BILINEAR)
        pixels = np.asarray(shrunk, np.float32) / 255
        given = {
            one.name: np.array([picture.size], np.int64)
            if one.name == SIZES
            else pixels.transpose(2, 0, 1)[None].astype(_TYPES[one.type])
            for one in self._session.get_inputs()
        }
        names = [one.name for one in self._session.get_outputs()]
        outputs = dict(zip(names, self._session.run(None, given), strict=True))
        classes = len(self._contract.labels)
        scores, boxes = _form(names)(outputs, picture.size, classes)
        if not (np.isfinite(scores).all() and scores.shape == (len(boxes), classes)):
            raise ModelError(
                f"the detector's scores are {scores.shape}, or not numbers; expected"
                f" {(len(boxes), classes)}",
                hint="the manifest's labels are the model's classes, in its order",
            )
        return scores, boxes

    def _asked(self, texts: Sequence[str]) -> dict[int, str]:
        """Return the class of each text: the longest label among its words. Raises BadRequest."""
        labels = sorted(enumerate(self._contract.labels), key=lambda item: -len(item[1]))
        asked: dict[int, str] = {}
        for text in texts:
            named = (n for n, label in labels if re.search(rf"(?i)\b{re.escape(label)}\b", text))
            if (number := next(named, None)) is None:
                raise BadRequest(
                    f"this detector knows no {text[:40]!r}",
                    hint=f"ask for {', '.join(self._contract.labels)[:400]}",
                )
            asked.setdefault(number, text)
        return asked

    def _open(self, given: list[Provider], threads: int = 0) -> Any:
        """Return a session; `threads` 0: as many as the process may use. One makes none beside it:
        the process that reads weights is forked."""
        from vram_arbiter.sidecars.onnx_runtime import onnxruntime

        options = onnxruntime.SessionOptions()
        options.intra_op_num_threads = threads
        return onnxruntime.InferenceSession(str(self._file), options, providers=given)

    def _check(self, session: Any) -> None:
        """Raise ModelError for inputs and outputs that are of no known form."""
        _form([one.name for one in session.get_outputs()])
        pictures = [one for one in session.get_inputs() if one.name != SIZES]
        if len(pictures) != 1 or pictures[0].type not in _TYPES or len(pictures[0].shape) != 4:
            raise ModelError(
                f"{self._file.name} reads {[one.name for one in session.get_inputs()]}",
                hint=f"export it with one input of pictures, and {SIZES} at most",
            )
        height, width = pictures[0].shape[2:]
        for has, wants in zip((width, height), self._contract.input_size, strict=True):
            if isinstance(has, int) and has != wants:
                raise ModelError(
                    f"{self._file.name} reads pictures of {width} x {height}",
                    hint=f"write detector.input_size: [{width}, {height}]",
                )


def providers(manifest: RSkillManifest, device: str) -> list[Provider]:
    """Return ONNX Runtime's providers for a device (`cpu`, `none`, `cuda:N`, …), the first of which
    has to run the model.

    Raises ConfigError for one that this installation does not have: there is no other way.
    """
    need(f"runtime {manifest.runtime.value}", "onnxruntime", extra="onnx")
    from vram_arbiter.sidecars.onnx_runtime import onnxruntime

    kind, _, index = device.partition(":")
    place = {"device_id": index or "0"}
    on_cuda = (CUDA, place | CUDA_OPTIONS)
    wanted = [on_cuda] if kind == "cuda" else [(CPU, {})]
    if manifest.runtime is Runtime.TENSORRT:
        wanted = [(TENSORRT, place), on_cuda]
    first = wanted[0][0]
    has = onnxruntime.get_available_providers()
    if first not in has:
        raise ConfigError(
            f"{manifest.name}: runtime {manifest.runtime.value} on {kind} needs {first}, and this"
            f" onnxruntime has {', '.join(has)}",
            hint="install onnxruntime-gpu instead of onnxruntime"
            + (", and TensorRT" if first == TENSORRT else ""),
        )
    return wanted


def _file(folder: Path, dtype: Dtype) -> Path:
    """Return the model of a folder: the only one, else that of the number format. Raises
    ModelError."""
    files = sorted(folder.rglob("*.onnx"))
    named = [file for file in files if file.name == FILES.get(dtype)]
    wanted = files if len(files) == 1 else named
    if len(wanted) != 1:
        names = ", ".join(str(file.relative_to(folder)) for file in files) or "none"
        raise ModelError(
            f"expected one .onnx file for {dtype.value} in {folder}, found {names}",
            hint=f"name it {FILES.get(dtype, 'model.onnx')}",
        )
    return wanted[0]


def _of_transformers(outputs: Outputs, size: tuple[int, int], classes: int) -> Found:
    """Read `logits` (1, boxes, classes) and `pred_boxes` (1, boxes, 4: center, size; 0..1)."""
    import numpy as np

    logits = outputs["logits"][0].astype(np.float32)
    center, extent = np.split(outputs["pred_boxes"][0].astype(np.float32), 2, axis=-1)
    corners = np.concatenate([center - extent / 2, center + extent / 2], axis=-1)
    return 1 / (1 + np.exp(-logits)), corners * np.array(size * 2, np.float32)


def _of_exporter(outputs: Outputs, size: tuple[int, int], classes: int) -> Found:
    """Read `labels` and `scores` (1, boxes), and `boxes` (1, boxes, 4) in pixels."""
    import numpy as np

    labels, scores = outputs["labels"][0], outputs["scores"][0].astype(np.float32)
    return np.where(labels[:, None] == np.arange(classes), scores[:, None], 0), outputs["boxes"][0]


_FORMS: Final[Mapping[frozenset[str], Callable[[Outputs, tuple[int, int], int], Found]]] = {
    frozenset({"logits", "pred_boxes"}): _of_transformers,
    frozenset({"labels", "boxes", "scores"}): _of_exporter,
}
_TYPES: Final = {"tensor(float)": "float32", "tensor(float16)": "float16"}


def _form(names: Sequence[str]) -> Callable[[Outputs, tuple[int, int], int], Found]:
    """Return the reader of a model's outputs; it may have others beside them. Raises ModelError."""
    for needed, read in _FORMS.items():
        if needed <= set(names):
            return read
    known = " or ".join(", ".join(sorted(needed)) for needed in _FORMS)
    raise ModelError(f"the model answers {', '.join(names)}", hint=f"export it with {known}")
