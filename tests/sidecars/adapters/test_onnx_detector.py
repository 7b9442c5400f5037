"""Exported detectors through ONNX Runtime: tiny models that the tests make, with one box for each
half of the picture, whose score for `red` and `blue` is that color in it."""

import json
import os
import subprocess
import sys
import tempfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.conftest import MANIFEST
from tests.support import prepared
from tests.support.paths import ROOT
from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest, parse_manifest
from vram_arbiter.schemas.sidecar import DetectOp
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.onnx_detector import OnnxDetectorAdapter
from vram_arbiter.sidecars.weights import Weights

pytestmark = pytest.mark.heavy

CONTRACT = "{labels: [red, blue], input_size: [8, 4], score_threshold: 0.5}"
BOXES = [[0.25, 0.5, 0.5, 1.0], [0.75, 0.5, 0.5, 1.0]]  # center and size of the halves


def manifest_of(contract: str = CONTRACT, **fields: str) -> RSkillManifest:
    text = MANIFEST.format(name="eye").replace("{labels: [cube]}", contract)
    lines = {"runtime": "onnx"} | fields
    return parse_manifest(text + "".join(f"{key}: {value}\n" for key, value in lines.items()))


def picture() -> bytes:
    """Red on the left, blue on the right; 80 x 60 pixels."""
    import io

    from PIL import Image

    whole = Image.new("RGB", (80, 60), (255, 0, 0))
    whole.paste((0, 0, 255), (40, 0, 80, 60))
    stream = io.BytesIO()
    whole.save(stream, "PNG")
    return stream.getvalue()


def export(file: Path, form: str = "transformers", half: bool = False) -> None:
    """Write a detector whose outputs are those of `transformers`, of RT-DETR's own `exporter`, or
    of none (`other`)."""
    import numpy as np
    from onnx import TensorProto, helper, numpy_helper, save

    kind = TensorProto.FLOAT16 if half else TensorProto.FLOAT
    real = np.float16 if half else np.float32

    def constant(name: str, value: Any, dtype: Any = real) -> Any:
        return numpy_helper.from_array(np.array(value, dtype), name)

    def info(name: str, shape: list[int], dtype: int = kind) -> Any:
        return helper.make_tensor_value_info(name, dtype, shape)

    node = helper.make_node
    nodes = [  # (1, 3, 4, 8) → colors of the halves → (1, halves, [red, blue])
        node("Reshape", ["pixels", "halves"], ["split"]),
        node("ReduceMean", ["split", "rows"], ["means"], keepdims=0),
        node("Transpose", ["means"], ["turned"], perm=[0, 2, 1]),
        node("Gather", ["turned", "colors"], ["seen"], axis=2),
        node("Mul", ["seen", "twenty"], ["scaled"]),
        node("Sub", ["scaled", "ten"], ["logits"]),
    ]
    constants = [
        constant("halves", [1, 3, 4, 2, 4], np.int64),
        constant("rows", [2, 4], np.int64),
        constant("colors", [0, 2], np.int64),
        constant("twenty", 20.0),
        constant("ten", 10.0),
        constant("pred_boxes", [BOXES]),
    ]
    inputs = [info("pixels", [1, 3, 4, 8])]
    outputs = [info("logits", [1, 2, 2]), info("pred_boxes", [1, 2, 4])]
    if form == "exporter":
        inputs.append(info("orig_target_sizes", [1, 2], TensorProto.INT64))
        nodes += [
            node("Sigmoid", ["logits"], ["all"]),
            node("ReduceMax", ["all", "last"], ["scores"], keepdims=0),
            node("ArgMax", ["all"], ["labels"], axis=2, keepdims=0),
            node("Cast", ["orig_target_sizes"], ["sizes"], to=kind),
            node("Concat", ["sizes", "sizes"], ["corners"], axis=1),
            node("Mul", ["shares", "corners"], ["boxes"]),
        ]
        constants += [
            constant("last", [2], np.int64),
            constant("shares", [[[0.0, 0.0, 0.5, 1.0], [0.5, 0.0, 1.0, 1.0]]]),
        ]
        outputs = [
            info("labels", [1, 2], TensorProto.INT64),
            info("boxes", [1, 2, 4]),
            info("scores", [1, 2]),
        ]
    elif form == "other":
        outputs = outputs[:1]
    graph = helper.make_graph(nodes, "halves", inputs, outputs, constants)
    model = helper.make_model(graph, opset_imports=[helper.make_opsetid("", 18)], ir_version=10)
    save(model, file)


type Load = Callable[..., OnnxDetectorAdapter]


@pytest.fixture
def loaded(tmp_path: Path) -> Load:
    def load(manifest: RSkillManifest | None = None, **model: Any) -> OnnxDetectorAdapter:
        export(tmp_path / "model.onnx", **model)
        adapter = make_adapter(manifest or manifest_of(), Weights(str(tmp_path), local=True))
        assert isinstance(adapter, OnnxDetectorAdapter)
        adapter.prepare()
        adapter.load("cpu")
        adapter.place("cpu")
        return adapter

    return load


def labels_and_boxes(adapter: OnnxDetectorAdapter, query: str, **fields: Any) -> list[Any]:
    call = DetectOp(op="detect", image=picture(), query=query, **fields)
    reply = adapter.run(call)
    assert reply["answer"].count("<box>") == len(reply["detections"])
    return [(found["label"], found["box"]) for found in reply["detections"]]


@pytest.mark.parametrize("half", [False, True])
@pytest.mark.parametrize("form", ["transformers", "exporter"])
def test_what_is_asked_for_is_found_in_the_pictures_pixels(
    loaded: Load, form: str, half: bool
) -> None:
    adapter = loaded(form=form, half=half)
    left, right = [0.0, 0.0, 40.0, 60.0], [40.0, 0.0, 80.0, 60.0]
    assert labels_and_boxes(adapter, "red") == [("red", left)]
    assert labels_and_boxes(adapter, "a Blue thing</c>red") in (
        [("a Blue thing", right), ("red", left)],
        [("red", left), ("a Blue thing", right)],
    )
    assert labels_and_boxes(adapter, "blue", score_threshold=1.0) == []


def test_a_class_that_the_model_has_not_is_refused_and_not_unseen(loaded: Load) -> None:
    with pytest.raises(BadRequest, match=r"knows no 'redness' \(ask for red, blue\)"):
        labels_and_boxes(loaded(), "red, redness")


def test_the_longest_label_is_what_a_text_names(loaded: Load) -> None:
    adapter = loaded(manifest_of(CONTRACT.replace("red, blue", "dog, hot dog")))
    assert labels_and_boxes(adapter, "a hot dog") == [("a hot dog", [40.0, 0.0, 80.0, 60.0])]


@pytest.mark.parametrize(
    ("contract", "form", "told"),
    [
        (CONTRACT, "other", "answers logits.*export it with logits, pred_boxes or boxes"),
        (CONTRACT.replace("8, 4", "4, 8"), "transformers", r"write detector.input_size: \[8, 4\]"),
    ],
)
def test_a_model_of_another_form_is_refused_at_the_load(
    loaded: Load, contract: str, form: str, told: str
) -> None:
    with pytest.raises(ModelError, match=told):
        loaded(manifest_of(contract), form=form)


def test_labels_that_are_not_the_models_classes_are_refused(loaded: Load) -> None:
    adapter = loaded(manifest_of(CONTRACT.replace("red, blue", "red, blue, green")))
    with pytest.raises(ModelError, match="the manifest's labels are the model's classes"):
        labels_and_boxes(adapter, "red")


def test_the_file_is_the_only_one_or_that_of_the_number_format(
    tmp_path: Path, loaded: Load
) -> None:
    export(tmp_path / "model_q4.onnx", "other")
    assert labels_and_boxes(loaded(), "red")
    with pytest.raises(ModelError, match=r"expected one .onnx file for fp16 .* found model.onnx, "):
        loaded(manifest_of(quantization="{dtype: fp16}"))
    (tmp_path / "model.onnx").write_bytes(b"")
    broken = make_adapter(manifest_of(), Weights(str(tmp_path), local=True))
    with pytest.raises(ModelError, match=r"model.onnx"):
        broken.load("meta")


@pytest.mark.parametrize(
    ("runtime", "device", "missing"),
    [
        ("tensorrt", "cpu", "TensorrtExecutionProvider"),
        ("tensorrt", "cuda:0", "TensorrtExecutionProvider"),
        ("onnx", "cuda:0", "CUDAExecutionProvider"),
    ],
)
def test_a_provider_that_is_absent_is_named(runtime: str, device: str, missing: str) -> None:
    """There is no silent change to the CPU."""
    from vram_arbiter.sidecars.onnx_runtime import onnxruntime

    if missing in onnxruntime.get_available_providers():
        pytest.skip(f"this onnxruntime has {missing}")
    adapter = make_adapter(manifest_of(runtime=runtime), Weights("/none", local=True))
    with pytest.raises(ConfigError, match=f"{runtime} on .* needs {missing}.*onnxruntime-gpu"):
        adapter.place(device)


def test_onnx_runtime_leaves_no_files_and_sends_nothing(tmp_path: Path) -> None:
    """Regression: its telemetry wrote a file into the temporary folder."""
    export(model := tmp_path / "model.onnx")
    (home := tmp_path / "home").mkdir()
    code = (
        "import sys; from vram_arbiter.sidecars.onnx_runtime import onnxruntime as o\n"
        "o.InferenceSession(sys.argv[1], providers=['CPUExecutionProvider'])"
    )
    places = dict.fromkeys(("HOME", "TMPDIR", "XDG_CACHE_HOME"), str(home))
    kept = {key: value for key, value in os.environ.items() if key != "CI"}
    environ = kept | places | {"PYTHONPATH": f"{ROOT}/src", "PYTHONDONTWRITEBYTECODE": "1"}
    environ.pop("ORT_DISABLE_TELEMETRY", None)
    subprocess.run([sys.executable, "-c", code, str(model)], env=environ, check=True)
    assert list(home.rglob("*")) == []


@pytest.mark.anyio
@pytest.mark.e2e
async def test_a_sidecar_serves_an_exported_detector() -> None:
    with tempfile.TemporaryDirectory(prefix="on") as folder:
        configs = Path(folder)
        (configs / "models/halves").mkdir(parents=True)
        export(configs / "models/halves/model.onnx")
        manifest = manifest_of().model_copy(update={"weights_uri": "local://models/halves"})
        (configs / "rskill.yaml").write_text(json.dumps(manifest.model_dump(mode="json")))
        endpoint = f"ipc://{folder}/eye.sock"
        words = [
            "--name", "eye", "--no-arbiter", "--rskill", f"{folder}/rskill.yaml",
            "--configs", folder, "--device", "none", "--footprint", "1GB",
            "--endpoint", endpoint,
        ]  # fmt: skip
        checked = prepared.run("vram-sidecar", [*words, "--check"], os.environ, PATIENCE_S)
        assert checked.returncode == 0, checked.stdout
        sidecar = prepared.start("vram-sidecar", words, os.environ)
        try:
            async with DetectorClient(endpoint, connect_timeout_s=PATIENCE_S) as client:
                (found,) = await client.detect(picture(), "red")
            assert (found.label, found.box) == ("red", (0.0, 0.0, 40.0, 60.0))
        finally:
            sidecar.terminate()
            assert sidecar.wait(PATIENCE_S) == 0
