"""`python -m vram_arbiter.schemas` as people run it, and the exported JSON Schemas that must not
drift from the models."""

import functools
import json
from importlib import import_module
from pathlib import Path

import pytest

from vram_arbiter import schemas
from vram_arbiter.schemas import export
from vram_arbiter.schemas.__main__ import main
from vram_arbiter.schemas.export import modules, public_models

SAMPLES = sorted((Path(__file__).parent / "manifest/samples").glob("*.yaml"))
EXPORTED = Path(schemas.__file__).parent / "json"
documents = functools.cache(export.documents)


def write_changed(folder: Path, kind: str, old: str, new: str, more: str = "") -> Path:
    """Write a sample of a kind with a change in it."""
    text = next(path for path in SAMPLES if path.stem == kind).read_text(encoding="utf-8")
    assert old in text
    (folder / "rskill.yaml").write_text(text.replace(old, new) + more, encoding="utf-8")
    return folder / "rskill.yaml"


def test_check_says_ok_for_good_files(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", *map(str, SAMPLES)]) == 0
    assert capsys.readouterr().out.splitlines() == [f"{path}: ok" for path in SAMPLES]


def test_check_names_every_wrong_field_and_goes_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    wrong = write_changed(tmp_path, "detector", "chunk_size: 1", "chunk_size: 0", "colour: red\n")
    assert main(["check", str(tmp_path), str(SAMPLES[1])]) == 1
    out, err = capsys.readouterr()
    lines = out.splitlines()
    assert [line.partition(": ")[2].partition(":")[0] for line in lines[:2]] == [
        "chunk_size",
        "colour",
    ]
    assert lines[0].startswith(f"{wrong}:")
    assert lines[2] == f"{SAMPLES[1]}: ok"
    assert err == "1 of 2 files are invalid\n"


def test_check_refuses_a_policy_that_sees_nothing(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: it said ok, and every runner refused the skill."""
    write_changed(tmp_path, "vla", ', vla_feature_key: "observation.images.front"', "")
    assert main(["check", str(tmp_path)]) == 1
    said = capsys.readouterr().out
    assert "rskill.yaml: sensors_required: names no camera: give a sensor of modality rgb" in said


def test_check_of_a_missing_file(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["check", str(tmp_path / "none.yaml")]) == 1
    assert (
        capsys.readouterr().out
        == f"{tmp_path / 'none.yaml'}: cannot be read: No such file or directory\n"
    )


def test_warnings_go_beside_the_verdict(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    written = write_changed(tmp_path, "vlm", 'role: "s2"', 'role: "s1"')
    assert main(["check", str(tmp_path)]) == 0
    out, err = capsys.readouterr()
    assert out == f"{written}: ok\n"
    assert err.startswith("warning: ")
    assert "role: " in err


@pytest.mark.parametrize("arguments", [[], ["check"], ["export"], ["make"], ["export", "a", "b"]])
def test_wrong_usage_ends_with_two(arguments: list[str]) -> None:
    with pytest.raises(SystemExit) as caught:
        main(arguments)
    assert caught.value.code == 2


def test_export_writes_valid_json(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    folder = tmp_path / "new" / "schemas"
    assert main(["export", str(folder)]) == 0
    assert capsys.readouterr().out.splitlines() == [str(folder / name) for name in documents()]
    rskill = json.loads((folder / "rskill.json").read_text(encoding="utf-8"))
    assert rskill["required"] == [
        "name", "version", "kind", "embodiment_tags", "chunk_size", "latency_budget", "description",
        "actions",
    ]  # fmt: skip


def test_export_into_a_file_fails_clearly(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "file").touch()
    assert main(["export", str(tmp_path / "file")]) == 1
    assert capsys.readouterr().err.startswith(f"cannot write to {tmp_path / 'file'}: ")


def test_committed_schemas_are_those_of_the_models() -> None:
    """Run `make schemas` where they are not."""
    committed = {path.name: path.read_text(encoding="utf-8") for path in EXPORTED.glob("*.json")}
    made = documents()
    assert [name for name in committed | made if committed.get(name) != made.get(name)] == []


def test_every_public_model_is_exported() -> None:
    exported = {name: json.loads(text).get("$defs", {}) for name, text in documents().items()}
    missing = [
        f"{name}: {model.__name__}"
        for name in modules()
        for model in public_models(import_module(f"vram_arbiter.schemas.{name}"))
        if model.__name__ not in exported[f"{name.partition('.')[0]}.json"]
    ]
    assert missing == []
