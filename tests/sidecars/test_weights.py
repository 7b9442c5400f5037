"""Where weights come from."""

import tempfile
from pathlib import Path

import pytest

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.schemas.errors import ConfigError, ModelError
from vram_arbiter.schemas.manifest.load import load_manifest
from vram_arbiter.sidecars.weights import (
    Weights,
    from_pretrained,
    read_config,
    resolve,
    unquantized_modules,
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


def test_modules_that_stay_unquantized_are_a_list_of_names():
    """A bare text would be taken apart into its letters, and every module would be quantized."""
    manifest = load_manifest(configs_folder({}) / "rskills" / "so101-grab" / "rskill.yaml")
    assert unquantized_modules(manifest) == ["lm_head", "visual"]
    extra = {"skip_modules": "lm_head"}
    wrong = manifest.quantization.model_copy(update={"extra": extra})
    with pytest.raises(ConfigError, match="give a list of module names"):
        unquantized_modules(manifest.model_copy(update={"quantization": wrong}))


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
