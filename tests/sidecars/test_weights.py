"""Where weights come from."""

from pathlib import Path

import pytest

from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.schemas.errors import ConfigError, ModelError
from vram_arbiter.sidecars.weights import Weights, from_pretrained, resolve


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
