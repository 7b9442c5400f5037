"""The configuration: file and model say the same, and every mistake is named with its line."""

import json
import re

import pytest
import yaml
from jsonschema import Draft202012Validator

from tests.support.paths import ROOT
from vram_arbiter.schemas.config.arbiter import LIVE_KEYS, ArbiterConfig, load_config
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import parse_yaml

EXAMPLE = ROOT / "configs" / "arbiter.yaml"


def test_the_example_equals_the_defaults() -> None:
    assert load_config(EXAMPLE.read_text(), "arbiter.yaml") == ArbiterConfig()


def test_the_example_states_every_key() -> None:
    stated = yaml.safe_load(EXAMPLE.read_text())
    wanted = {
        name: set(type(getattr(ArbiterConfig(), name)).model_fields)
        for name in ArbiterConfig.model_fields
    }
    assert {name: set(section) for name, section in stated.items()} == wanted


def test_every_key_of_the_example_has_a_comment_with_its_default() -> None:
    lines = EXAMPLE.read_text().splitlines()
    for path, at in parse_yaml(EXAMPLE.read_text(), "arbiter.yaml").lines.items():
        if len(path) != 2 or isinstance(path[1], int):
            continue
        comment = []
        for line in reversed(lines[: at - 1]):
            if not line.lstrip().startswith("#"):
                break
            comment.append(line)
        assert "Default:" in " ".join(comment), f"{path} has no comment that states its default"


def test_the_example_marks_the_keys_that_a_reload_applies() -> None:
    section, comment, marked = "", "", set()
    for line in EXAMPLE.read_text().splitlines():
        if found := re.match(r"(  )?(\w+):", line):
            section = section if found[1] else found[2]
            if "Reload: yes." in comment:
                marked.add((section, found[2]))
        comment = comment + line if line.lstrip().startswith("#") else ""
    assert marked == {(section, key) for section, keys in LIVE_KEYS.items() for key in keys}


def test_an_editor_accepts_the_example_and_marks_mistakes() -> None:
    """By the JSON Schema that its first line names. A size is a number, or a text such as 8GiB."""
    text = EXAMPLE.read_text()
    first = re.match(r"# yaml-language-server: \$schema=(\S+)\n", text)
    assert first
    reader = Draft202012Validator(json.loads((EXAMPLE.parent / first[1]).read_text()))
    assert list(reader.iter_errors(yaml.safe_load(text))) == []
    for mistake in ({"verfiy": {}}, {"verify": {"timeout_s": -1}}, {"gpu": {"reserve_bytes": -1}}):
        assert list(reader.iter_errors(mistake)), mistake


def test_every_key_of_the_model_has_a_description() -> None:
    for name in ArbiterConfig.model_fields:
        section = type(getattr(ArbiterConfig(), name))
        for key, field in section.model_fields.items():
            assert field.description, f"{name}.{key} says nothing about itself"


def test_an_empty_file_is_the_default() -> None:
    assert load_config("", "x.yaml") == ArbiterConfig()
    assert load_config("verify:\n  # nothing here\n", "x.yaml") == ArbiterConfig()


def test_sizes_are_read_as_people_write_them() -> None:
    config = load_config("gpu:\n  reserve_bytes: 0.5GiB\n  capacity_bytes: {'0': 8GiB}\n", "x.yaml")
    assert config.gpu.reserve_bytes == 2**29
    assert config.gpu.capacity_bytes == {"0": 8 * 2**30}


def problem(text: str) -> str:
    with pytest.raises(ConfigError) as raised:
        load_config(text, "arbiter.yaml")
    assert raised.value.details["fields"]
    return raised.value.message


def test_a_mistyped_key_is_named_with_line_and_suggestion() -> None:
    text = "# comment\nverify:\n  confirm_s: 0.01\n  tiemout_s: 3\n"
    assert problem(text) == "arbiter.yaml:4: verify.tiemout_s: unknown key; did you mean timeout_s?"


def test_a_mistyped_section_is_named() -> None:
    assert (
        problem("verfiy:\n  timeout_s: 1\n")
        == "arbiter.yaml:1: verfiy: unknown key; did you mean verify?"
    )


def test_a_key_that_resembles_nothing_lists_the_known_ones() -> None:
    assert "known here: days, max_events" in problem("history:\n  zzz: 1\n")


def test_every_mistake_of_a_file_is_reported() -> None:
    text = "limits:\n  sessions_max: 0\nverify:\n  timeout_s: soon\n  tolerance_bytes: 12 parsecs\n"
    lines = problem(text).splitlines()
    assert [line.split(": ")[0] for line in lines] == [
        "arbiter.yaml:2",
        "arbiter.yaml:4",
        "arbiter.yaml:5",
    ]
    assert "not a size: '12 parsecs'" in lines[2]


@pytest.mark.parametrize(
    ("text", "line", "words"),
    [
        ("gpu: [\n", 2, "not valid YAML"),
        ("gpu:\n  source: \x08nvml\n", 2, "not valid YAML"),
        ("- 1\n", 1, "must be a mapping of fields"),
        ("42", 1, "must be a mapping of fields"),
        ("wire:\n  endpoint: tcp://0.0.0.0:5555\n", 2, "without CURVE keys"),
        ("wire:\n  endpoint: ipc://relative.sock\n", 2, "absolute path"),
        ("wire:\n  endpoint: ipc:///" + "x" * 120 + "\n", 2, "Linux allows 107"),
        ("wire:\n  endpoint: nonsense\n", 2, "is not an endpoint"),
        ("gpu:\n  source: cuda\n", 2, "write auto, nvml, unified, drm, fake:8GiB"),
    ],
)
def test_bad_text_is_a_config_error_with_a_line(text: str, line: int, words: str) -> None:
    """Regression: a control character in `arbiter.yaml` ended the daemon with a traceback."""
    message = problem(text)
    assert re.match(rf"arbiter\.yaml:{line}(:\d+)?: ", message)
    assert words in message
