"""`vram-sidecar --check`: every reason why a model cannot be served, before anything is loaded."""

import importlib.util
import json
import shutil
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from tests.support.paths import CONFIGS
from vram_arbiter.arbiter.host.gpu.fake import make_gpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ModelError, NoGpu, UnsupportedQuantization
from vram_arbiter.schemas.manifest import Kind, load_manifest
from vram_arbiter.sidecars.__main__ import main
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.policy_families import FAMILIES
from vram_arbiter.sidecars.device.capacity import capacities

pytestmark = pytest.mark.heavy

PAGE = (CONFIGS.parent / "docs/reference/models.md").read_text(encoding="utf-8")
SHIPPED = sorted(CONFIGS.glob("rskills/*/rskill.yaml"))
HEAD = (
    "version: 0.1.0\nembodiment_tags: [any]\nchunk_size: 1\ndescription: d\n"
    "latency_budget: {per_chunk_ms: 1}\n"
)
ARM = "actuators_required: [{kind: joint_position, control_mode_semantics: {mode: delta}}]\n"
INT4 = "quantization: {dtype: int4}\n"


def of_hub(repository: str) -> str:
    return f"name: {repository}\nweights_uri: hf://{repository}\n"


def nf4(more: str) -> str:
    return (
        "quantization: {dtype: int4, extra: {scheme: nf4, quantizer: bitsandbytes, "
        f"compute_dtype: bfloat16, min_params_to_quantize: 4000000, {more}}}}}\n"
    )


def processors(repository: str) -> str:
    return (
        f"processors: {{preprocessor_uri: hf://{repository}/policy_preprocessor.json, "
        f"postprocessor_uri: hf://{repository}/policy_postprocessor.json}}\n"
    )


PI05 = "OpenRAL/rskill-pi05-robocasa365-human300-nf4"
RLDX = "RLWRLD/RLDX-1-FT-RC365"
FIELD = {  # what decides in the field's files, and the findings that must be bad
    "locateanything-3b-nf4": (
        of_hub("OpenRAL/rskill-locateanything-3b-nf4")
        + "source_repo: hf://nvidia/LocateAnything-3B@7a81d810571dc5f244b2f0b6868128f24b1cbd85\n"
        + nf4("loader: transformers.AutoModel, trust_remote_code: true")
        + "license: nvidia_non_commercial\nkind: detector\nactions: [detect]\n"
        "min_vram_gb: {int4: 5.0}\ndetector: {labels: [cup], mode: on_demand, max_side: 512}\n",
        {"license", "family", "weights"},  # code of the hub, of any commit
    ),
    "locateanything-3b-nf4, pinned": (
        "name: OpenRAL/rskill-locateanything-3b-nf4\nlicense: nvidia_non_commercial\n"
        "weights_uri: hf://nvidia/LocateAnything-3B@7a81d810571dc5f244b2f0b6868128f24b1cbd85\n"
        + nf4("loader: transformers.AutoModel, trust_remote_code: true")
        + "kind: detector\nactions: [detect]\n"
        "min_vram_gb: {int4: 5.0}\ndetector: {labels: [cup], mode: on_demand, max_side: 512}\n",
        {"license", "weights"},
    ),
    "omdet-turbo-locator": (
        "name: OpenRAL/rskill-omdet-turbo-locator\nlicense: apache-2.0\nkind: detector\n"
        "weights_uri: hf://omlab/omdet-turbo-swin-tiny-hf\nquantization: {dtype: fp16}\n"
        "actions: [detect]\ndetector: {labels: [cup], engine: zeroshot_hf}\n",
        {"weights"},
    ),
    "pi05-robocasa365-human300-nf4": (
        of_hub(PI05) + processors(PI05) + INT4 + ARM + "license: apache-2.0\nkind: vla\n"
        "model_family: pi05\nactions: [pick]\n",
        {"weights"},
    ),
    "qwen35-4b-nf4": (
        of_hub("OpenRAL/rskill-qwen35-4b-nf4")
        + "source_repo: hf://Qwen/Qwen3.5-4B@851bf6e806efd8d0a36b00ddf55e13ccb7b8cd0a\n"
        + nf4("loader: transformers.AutoModelForImageTextToText")
        + "license: apache-2.0\nkind: vlm\nrole: s2\nactions: [query]\nmin_vram_gb: {int4: 2.5}\n",
        {"weights"},
    ),
    "rldx1-ft-rc365-nf4": (
        of_hub(RLDX) + processors(RLDX) + INT4 + ARM + "license: rlwrld_non_commercial\nkind: vla\n"
        "model_family: rldx\nactions: [pick]\nmin_vram_gb: {int4: 7.0}\n",
        {"license", "family", "weights"},
    ),
    "rskill-nav2-navigate-to-pose": (
        "name: OpenRAL/rskill-nav2-navigate-to-pose\nlicense: apache-2.0\nkind: ros_action\n"
        "actions: [navigate]\nactuators_required: [{kind: body_twist, control_mode_semantics: "
        "{mode: absolute}}]\nros_integration: {package: nav2_msgs, interface_type: NavigateToPose, "
        "interface_name: /navigate_to_pose, default_goal_json: '{}'}\n",
        {"family", "weights"},
    ),
}


class Whole:
    """An adapter whose checkpoint is whole; `raises` is what its load raises."""

    kind = "detector"
    loaded: tuple[str, ...] = ()
    offline = False
    raises: Exception | None = None

    def __init__(self, manifest: Any, weights: Any) -> None:
        self._weights = weights

    def prepare(self) -> None:
        from huggingface_hub import is_offline_mode

        type(self).offline = is_offline_mode()
        print("a loader says something")

    def load(self, device: str) -> None:
        if self.raises is not None:
            raise self.raises
        type(self).loaded += (device, self._weights.source)


type Check = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def check(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Check:
    """Run `--check` of a manifest's text with an empty cache of the hub, in `tmp_path/hub`. Returns
    the exit code, the findings by name (the worst where there are two), and what was printed."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path / "hub"))
    monkeypatch.setattr(Whole, "loaded", ())
    monkeypatch.setattr(Whole, "raises", None)

    def check(
        manifest: str | Path, *flags: str, adapter: Any = Whole
    ) -> tuple[int, dict[str, Any], str]:
        path = manifest
        if isinstance(manifest, str):
            path = tmp_path / "rskill.yaml"
            path.write_text(HEAD + manifest, encoding="utf-8")
        argv = ["--name", "x", "--rskill", str(path), "--check", "--configs", str(CONFIGS), *flags]
        code = main([*argv, "--json"], adapter)
        found = sorted(json.loads(capsys.readouterr().out), key=lambda one: one["ok"] is False)
        assert main(argv, adapter) == code
        printed = capsys.readouterr().out
        assert len(printed.splitlines()) == len(found) + 1
        return code, {one["what"]: one for one in found}, printed

    return check


def bad(findings: dict[str, Any]) -> set[str]:
    return {what for what, finding in findings.items() if finding["ok"] is False}


@pytest.mark.parametrize("name", FIELD)
def test_a_field_manifest_that_cannot_load_is_not_ok(check: Check, name: str) -> None:
    """Regression: three of these six were `ok`, with weights that are not here or of a family that
    nothing loads."""
    text, expected = FIELD[name]
    code, findings, printed = check(text, "--device", "none", adapter=make_adapter)
    assert code == 2
    assert bad(findings) == expected
    assert "not ok: " in printed.splitlines()[-1]
    if "weights_uri" in text:
        declared = "min_vram_gb" in findings["footprint"]["says"]
        assert declared is name.startswith("rldx1"), "the others are on file"
        assert "weights are not here: `hf download " in findings["weights"]["says"]
    else:
        assert "sidecars serve detector, vlm, vla and reward" in findings["weights"]["says"]


@pytest.mark.parametrize("path", SHIPPED, ids=lambda path: path.parent.name)
def test_a_shipped_manifest_lacks_at_most_its_weights(check: Check, path: Path) -> None:
    """Their families, licenses, number formats and footprints are known here."""
    manifest = load_manifest(path)
    here = (manifest.weights_uri or "").startswith("local://")
    flags = [] if manifest.is_commercial_use_allowed else ["--allow-noncommercial"]
    code, findings, _ = check(
        path, "--device", "none", *flags, adapter=Whole if here else make_adapter
    )
    if manifest.weights_uri is None:
        assert manifest.kind in (Kind.ROS_ACTION, Kind.ROS_SERVICE)
        return
    lacking = set() if here else {"weights"}
    family = FAMILIES.get(manifest.model_family)
    if family and not all(map(importlib.util.find_spec, family.packages)):
        lacking.add("packages")
    assert bad(findings) == lacking
    assert code == (2 if lacking else 0)
    if not here:
        row = next(line for line in PAGE.splitlines() if f"`{path.parent.name}`" in line)
        assert f"| {manifest.quantization.dtype} |" in row
    assert "min_vram_gb" not in findings["footprint"]["says"], "on file, not only declared"


@pytest.mark.parametrize("name", FAMILIES)
def test_the_page_names_every_policy_family(name: str) -> None:
    family = FAMILIES[name]
    row = next(line for line in PAGE.splitlines() if f"`{name}`" in "".join(line.split("|")[1:2]))
    for word in (*family.types, *family.packages, *family.precisions):
        assert word in row


DETECTOR = (
    of_hub("test/model")
    + "kind: detector\nactions: [detect]\ndetector: {labels: [cup]}\nlicense: mit\n"
)


def put_into_cache(hub: Path) -> Path:
    """Lay a snapshot into the hub's cache as a download does; return its folder."""
    place = hub / "models--test--model"
    folder = place / "snapshots" / "0123"
    folder.mkdir(parents=True)
    (place / "refs").mkdir()
    (place / "refs/main").write_text("0123")
    for name in ("config.json", "model.safetensors"):
        shutil.copy(CONFIGS / "models/so101-detector" / name, folder / name)
    return folder


def test_all_is_well_and_nothing_was_downloaded(check: Check, tmp_path: Path) -> None:
    folder = put_into_cache(tmp_path / "hub")
    code, findings, printed = check(DETECTOR, "--device", "none", "--footprint", "2GB,2GB,0,3GB")
    assert (code, bad(findings)) == (0, set())
    assert findings["gpu"] | {"ok": None, "says": "not checked: --device none"} == findings["gpu"]
    assert "charged 2.79 GiB while resident" in findings["footprint"]["says"]
    assert printed.splitlines()[-1] == "ok"
    assert Whole.offline
    assert Whole.loaded == ("meta", str(folder)) * 2


def test_every_finding_is_collected(check: Check, tmp_path: Path) -> None:
    make_gpu(tmp_path / "gpu", 2 * GIB)
    gpu = f"fake:{tmp_path / 'gpu'}"
    closed = DETECTOR.replace("mit", "proprietary")
    code, findings, _ = check(closed, "--device", gpu, "--footprint", "2GiB", adapter=make_adapter)
    assert (code, bad(findings)) == (2, {"license", "weights", "gpu"})
    assert findings["gpu"]["says"].endswith("has 2 GiB, 300 MiB of it reserved: 300 MiB too small")
    code, findings, _ = check(closed, "--device", gpu, "--allow-noncommercial")
    assert (code, bad(findings)) == (2, {"weights", "footprint"})
    assert findings["gpu"]["ok"] is None
    eighths = closed + "quantization: {dtype: int8}\n"
    code, findings, _ = check(eighths, "--device", gpu, "--footprint", "1GB", adapter=make_adapter)
    assert (code, bad(findings)) == (2, {"license", "weights", "precision"})
    assert "quantization.dtype 'int8' is not served" in findings["precision"]["says"]
    local = DETECTOR.replace("hf://test/model", "local://models/none")
    code, findings, _ = check(local, "--device", gpu, "--footprint", "1GB", adapter=make_adapter)
    assert (code, bad(findings)) == (2, {"weights"})
    assert "no weights in " in findings["weights"]["says"]


def test_a_gpu_that_may_come_is_no_reason_to_give_up(check: Check, tmp_path: Path) -> None:
    """systemd starts a sidecar again unless it ended with 2."""
    put_into_cache(tmp_path / "hub")
    flags = ("--device", f"fake:{tmp_path}", "--footprint", "1GB")
    code, findings, _ = check(DETECTOR, *flags)
    assert (code, bad(findings)) == (1, {"gpu"})
    assert "start the arbiter with --gpu fake:8GiB" in findings["gpu"]["says"]
    assert check(DETECTOR.replace("mit", "unknown"), *flags)[0] == 2


@pytest.mark.parametrize(
    ("error", "what", "says"),
    [
        (ModelError("3 missing from it (a, b, c)"), "weights", "3 missing from it"),
        (ImportError("OmDetTurbo requires the timm library"), "packages", "requires the timm"),
        (UnsupportedQuantization("no layer is left"), "precision", "no layer is left"),
        (RuntimeError("the code of the model is wrong"), "weights", "RuntimeError: the code"),
    ],
)
def test_what_the_model_says_is_a_finding(
    check: Check,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    error: Exception,
    what: str,
    says: str,
) -> None:
    put_into_cache(tmp_path / "hub")
    monkeypatch.setattr(Whole, "raises", error)
    code, findings, _ = check(DETECTOR, "--device", "none", "--footprint", "1GB")
    assert (code, bad(findings)) == (2, {what})
    assert says in findings[what]["says"]


def test_a_license_keeps_a_sidecar_from_starting(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: a sidecar served what `vram-runner deploy` refuses to run."""
    (tmp_path / "rskill.yaml").write_text(HEAD + DETECTOR.replace("mit", "unknown"))
    flags = ["--name", "x", "--rskill", str(tmp_path / "rskill.yaml"), "--footprint", "1GB"]
    assert main([*flags, "--device", "none"]) == 2
    assert (
        "its license (unknown) does not allow commercial use; --allow-" in capsys.readouterr().err
    )
    assert main([*flags, "--device", "none", "--json"]) == 2
    assert "--json is for --check" in json.loads(capsys.readouterr().out)["error"]["message"]


class Nvml:
    """The module `pynvml` with two GPUs, of which the second has no memory of its own."""

    class NVMLError(Exception):
        pass

    class NVMLError_NotSupported(NVMLError):
        pass

    def nvmlInit(self) -> None: ...
    def nvmlShutdown(self) -> None: ...

    def nvmlDeviceGetCount(self) -> int:
        return 2

    def nvmlDeviceGetMigMode(self, handle: str) -> list[int]:
        return [0, 0]

    def nvmlDeviceGetHandleByIndex(self, index: int) -> str:
        return self.nvmlDeviceGetHandleByUUID(f"GPU-{index}")

    def nvmlDeviceGetHandleByUUID(self, uuid: str) -> str:
        if uuid not in ("GPU-0", "GPU-1"):
            raise self.NVMLError("Not Found")
        return uuid

    def nvmlDeviceGetUUID(self, handle: str) -> str:
        return handle

    def nvmlDeviceGetMemoryInfo(self, handle: str) -> Any:
        if handle == "GPU-1":
            raise self.NVMLError_NotSupported("Not Supported")
        return SimpleNamespace(total=8 * GIB)


def test_the_capacity_of_the_gpus_that_the_flag_means() -> None:
    nvml = Nvml()
    assert capacities("cuda", {}, nvml).keys() == {"GPU-0", "GPU-1"}
    assert capacities("cuda:0", {}, nvml) == {"GPU-0": 8 * GIB}
    assert capacities("cuda:1", {}, nvml)["GPU-1"] > GIB // 2, "the machine's own memory"
    for named in ("GPU-0", "0"):
        assert capacities("cuda", {"CUDA_VISIBLE_DEVICES": named}, nvml) == {"GPU-0": 8 * GIB}
    assert list(capacities("cuda:0", {"CUDA_VISIBLE_DEVICES": "1,0"}, nvml)) == ["GPU-1"]
    with pytest.raises(NoGpu, match="lists no GPU for --device cuda:2"):
        capacities("cuda:2", {}, nvml)
    with pytest.raises(NoGpu, match="Not Found"):
        capacities("cuda", {"CUDA_VISIBLE_DEVICES": "GPU-7"}, nvml)
