"""Where weights come from."""

import json
import os
import tempfile
from pathlib import Path
from typing import Any

import pytest

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.schemas.errors import ConfigError, ModelError, UnsupportedQuantization
from vram_arbiter.schemas.manifest.contracts import Quantization
from vram_arbiter.schemas.manifest.load import load_manifest
from vram_arbiter.sidecars.quantization import Nf4
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    model_options,
    read_config,
    resolve,
)


def test_a_hub_id_keeps_its_revision(tmp_path):
    assert resolve("hf://owner/repo@abc", tmp_path) == Weights("owner/repo", "abc")
    assert resolve("hf://owner/repo", tmp_path) == Weights("owner/repo")


def test_a_local_place_is_looked_up_in_the_configs_folder_and_nowhere_else(tmp_path):
    (tmp_path / "configs/models/x").mkdir(parents=True)
    configs = tmp_path / "configs"
    assert resolve("local://models/x", configs) == Weights(str(configs / "models/x"), local=True)
    for uri, told in (
        ("local://models/y", "no weights in"),
        ("local://../../etc", "not a source of weights"),
        ("ftp://x/y", "not a source of weights"),
    ):
        with pytest.raises(ConfigError, match=told):
            resolve(uri, configs)


def test_the_configs_folder(tmp_path):
    assert configs_folder({"VRAM_ARBITER_CONFIGS": str(tmp_path)}) == tmp_path
    assert (configs_folder({}) / "models" / "footprints.yaml").is_file()


def test_hub_and_folder_take_the_same_call(tmp_path):
    calls = []

    class Model:
        @classmethod
        def from_pretrained(cls, source, **options):
            calls.append((source, options))
            if source == "broken":
                raise OSError("no file named config.json")
            return cls()

    from_pretrained(Model, Weights("owner/repo", "abc"), dtype=1)
    from_pretrained(Model, Weights(str(Path("/x")), local=True))
    assert calls == [
        ("owner/repo", {"dtype": 1, "revision": "abc"}),
        ("/x", {"local_files_only": True}),
    ]
    with pytest.raises(
        ModelError, match=r"Model cannot load broken: OSError: no file named config\.json"
    ):
        from_pretrained(Model, Weights("broken"))


@pytest.mark.heavy
def test_a_part_that_is_not_in_the_cache_is_named(monkeypatch):
    """Regression: a checkpoint names its tokenizer by a repository of the hub. Where that was never
    fetched, the libraries said that they could not connect, and not to what."""
    hub = pytest.importorskip("huggingface_hub")
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)

    class Policy:
        @classmethod
        def from_pretrained(cls, source, **options):
            try:
                hub.hf_hub_download("test/no-such-tokenizer", "tokenizer.json", **options)
            except OSError as error:
                raise ValueError("a step cannot be made") from error

    with pytest.raises(ModelError) as refused:
        from_pretrained(Policy, Weights(str(Path("/x")), local=True), revision="v2")
    assert refused.value.message == (
        "Policy cannot load /x: test/no-such-tokenizer is not in the hub's cache: "
        "`hf download test/no-such-tokenizer --revision v2` fetches it"
    )


def asking(dtype: str) -> Any:
    manifest = load_manifest(configs_folder({}) / "rskills" / "so101-grab" / "rskill.yaml")
    asked = Quantization.model_validate({"dtype": dtype})
    return manifest.model_copy(update={"quantization": asked})


@pytest.mark.heavy
def test_the_precision_is_the_manifests_whatever_the_device(tmp_path, monkeypatch):
    """Regression: on the CPU every model was float32, and int8 was bf16 on a GPU. Shards are read
    one after the other."""
    torch = pytest.importorskip("torch")
    monkeypatch.delenv("HF_DEACTIVATE_ASYNC_LOAD", raising=False)
    (tmp_path / "config.json").write_text("{}")
    weights = Weights(str(tmp_path), local=True)
    types = {"fp32": torch.float32, "fp16": torch.float16, "bf16": torch.bfloat16}
    for device in ("cpu", "meta"):
        for dtype, found in types.items():
            options = model_options(asking(dtype), weights, device)
            assert options == {"device_map": {"": device}, "dtype": found}
        options = model_options(asking("int4"), weights, device)
        assert options == {"device_map": {"": device}, "dtype": torch.bfloat16, "nf4": Nf4()}
        for dtype in ("int8", "fp8", "fp4_nvfp4"):
            with pytest.raises(UnsupportedQuantization):
                model_options(asking(dtype), weights, device)
    assert os.environ["HF_DEACTIVATE_ASYNC_LOAD"] == "1"


@pytest.mark.heavy
def test_a_quantized_checkpoint_is_loaded_by_a_manifest_that_says_so_only(tmp_path):
    nf4 = {"quant_method": "bitsandbytes", "load_in_4bit": True, "bnb_4bit_quant_type": "nf4"}
    weights = Weights(str(tmp_path), local=True)

    def options(dtype, **quantized):
        (tmp_path / "config.json").write_text(json.dumps({"quantization_config": quantized}))
        return model_options(asking(dtype), weights, "cpu")

    assert options("int4", **nf4)["nf4"] == Nf4()
    with pytest.raises(UnsupportedQuantization, match=r"NF4 of bitsandbytes.*is 'bf16'.*int4"):
        options("bf16", **nf4)
    with pytest.raises(UnsupportedQuantization, match=r"quantized \(gptq\)"):
        options("int4", quant_method="gptq")
    with pytest.raises(UnsupportedQuantization, match=r"quantized \(bitsandbytes\)"):
        options("int4", **nf4 | {"bnb_4bit_quant_type": "fp4"})
    (tmp_path / "config.json").unlink()
    with pytest.raises(ModelError, match=r"its config\.json cannot be read"):
        model_options(asking("int4"), weights, "cpu")


@pytest.mark.heavy
def test_reading_a_configuration_leaves_no_temporary_file(tmp_path, monkeypatch):
    """lerobot parses a configuration through a temporary file and keeps it; each start of a policy
    sidecar left one."""
    configs = pytest.importorskip("lerobot.configs.policies")
    import vram_arbiter.sidecars.models.compact_act  # noqa: F401  registers itself

    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path))
    weights = resolve("local://models/so101-grab", configs_folder({}))
    found = read_config(configs.PreTrainedConfig, weights)
    assert list(tmp_path.glob("tmp*")) == []
    assert found == configs.PreTrainedConfig.from_pretrained(weights.source)
    nothing = tmp_path / "nothing"
    nothing.mkdir()
    with pytest.raises(ModelError, match=r"PreTrainedConfig cannot load .*config\.json"):
        read_config(configs.PreTrainedConfig, Weights(str(nothing), local=True))
