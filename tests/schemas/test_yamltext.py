"""One loader reads all YAML of the product; a hostile text ended in RecursionError, AttributeError
or gigabytes of memory."""

import re
import time
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.support.deployment import load_robot
from tests.support.paths import ROOT
from vram_arbiter.schemas import yamltext
from vram_arbiter.schemas.config.arbiter import load_config
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import ManifestError, parse_manifest
from vram_arbiter.schemas.yamltext import DEPTH_MAX, TEXT_MAX_BYTES, parse_yaml, read_yaml

DEEP_BY_ALIASES = "a: &a " + "[" * 40 + "]" * 40 + "\nb: " + "[" * 40 + "*a" + "]" * 40
LAUGHS = "a: &a {x: 1, y: 2}\n" + "".join(
    f"{new}: &{new} {{<<: [{', '.join([f'*{old}'] * 20)}]}}\n"
    for old, new in zip("abcdef", "bcdefg", strict=True)
)


TWICE = "".join(
    f"a{n}: &a{n} {{x: {value}, x: {value}}}\n"
    for n, value in enumerate(["1", *[f"*a{n}" for n in range(60)]])
)
"""Each level names the one before under one key twice; read again each time, it took 2**60
steps."""


def said(content: str | bytes) -> str:
    with pytest.raises(ConfigError) as raised:
        parse_yaml(content, "x.yaml")
    assert raised.value.details["fields"]
    return raised.value.message


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("gpu: &a\n  source: *a", "x.yaml:1:6: gpu.source: contains itself"),
        ("gpu: &a [*a]", "x.yaml:1:6: gpu[0]: contains itself"),
        ("gpu: &a {<<: *a}", "x.yaml:1:6: gpu.<<: contains itself"),
        ("&a ? *a\n: 1", "not valid YAML"),
        ("[" * 100_000, "x.yaml:1:65: not valid YAML: nested deeper than 64 levels"),
        ("{a: " * 100_000, "nested deeper than 64 levels"),
        ("- " * 100_000, "x.yaml:1:129: not valid YAML: nested deeper than 64 levels"),
        ("? " * 100_000, "nested deeper than 64 levels"),
        (DEEP_BY_ALIASES, "nested deeper than 64 levels, aliases expanded"),
        (LAUGHS, "more than 100000 values, aliases expanded"),
        ("a: !!timestamp x", "x.yaml:1:4: not valid YAML: 'x' cannot be read as timestamp"),
        ("a: !!bool x", "x.yaml:1:4: not valid YAML: 'x' cannot be read as bool"),
        ("a: !!int ''", "x.yaml:1:4: not valid YAML: '' cannot be read as int"),
        ("a: !!float x", "x.yaml:1:4: not valid YAML: 'x' cannot be read as float"),
        ("a: !!map x", "x.yaml:1:4: not valid YAML: expected a mapping node"),
        ("a:\n - !!binary aGk=", "x.yaml:2:4: a[0]: the tag !!binary is not read here"),
        ("a: !!set {x}", "the tag !!set is not read here"),
        ("a: !mine x", "the tag !mine is not read here"),
        ("!!python/name:os.system x: 1", "the tag !!python/name:os.system is not read here"),
        ("a: " + "9" * 5000, "x.yaml:1:4: a: 5000 characters are too many for the type int"),
        ("a: 1" + ":59" * 5000, "too many for the type int"),
        ("a: 0x" + "f" * 5000, "too many for the type int"),
        ("? {a: 1}\n: x", "x.yaml:1:3: a key must be a single value"),
        ('a: "\\0"', "x.yaml:1:4: a: holds a character that no text may hold"),
        ('a: "\\ud800"', "x.yaml:1:4: a: holds a character that no text may hold"),
        ('\na: "\\Uffffffff"', "x.yaml:2: not valid YAML"),
        ("%YAML " + "9" * 5000 + ".1\n--- a", "x.yaml:1: not valid YAML"),
        ("a: 1\nb: \x07", "x.yaml:2:4: not valid YAML: special characters are not allowed"),
        ("a: 1\na: 2\nb: 1\nb: 2", "x.yaml:4:1: b: key given twice; first in line 3"),
        ("a: 1\n---\nb: 2\n", "x.yaml:2:1: not valid YAML: expected a single document"),
        ("a: *nobody", "x.yaml:1:4: not valid YAML: found undefined alias 'nobody'"),
        (b"a: 1\nb: \xff", "x.yaml:2: not UTF-8 text"),
        (b"#" * (TEXT_MAX_BYTES + 1), "x.yaml: larger than 1048576 bytes"),
    ],
)  # fmt: skip
def test_a_text_that_cannot_be_read_names_its_place(content: str | bytes, expected: str) -> None:
    assert expected in said(content)


def test_values_are_counted_before_they_are_kept(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(yamltext, "NODES_MAX", 100)
    assert "x.yaml:1:200: not valid YAML: more than 100 values" in said("[" + "1," * 200 + "]")
    assert parse_yaml("[" + "1," * 99 + "]", "x").data


def test_an_alias_that_multiplies_is_named_by_its_line() -> None:
    lines = ["a0: &a0 [x, x, x, x, x, x, x, x, x, x]"]
    lines += [f"a{n}: &a{n} [{', '.join([f'*a{n - 1}'] * 10)}]" for n in range(1, 12)]
    assert said("\n".join(lines)) == (
        "x.yaml:5:5: not valid YAML: more than 100000 values, aliases expanded"
    )


def test_the_limits_leave_room_for_what_people_write() -> None:
    deep = "[" * (DEPTH_MAX - 1) + "]" * (DEPTH_MAX - 1)
    assert parse_yaml(f"a: {deep[1:-1]}", "x").data
    text = "base: &base {rate: 2, when: 2026-01-02}\nhere: {<<: *base, rate: 3}\n~: .inf\n7: 0x1f\n"
    found = parse_yaml("\ufeff".encode() + text.encode(), "x")
    assert found.data["here"]["rate"] == 3
    assert found.line(("here", "rate")) == 2


def test_a_key_is_the_text_that_stands_in_the_file() -> None:
    """Regression: `on:` was a truth value, and `7:` a number whose mistakes had no line."""
    found = parse_yaml("on: 1\n7: 0x1f\n~: 2\n2026-01-02: &n 5\n*n : 4", "x")
    texts = {"on": 1, "7": 31, "~": 2, "2026-01-02": 5, "5": 4}
    assert found.data == texts
    assert [found.line((key,)) for key in texts][:4] == [1, 2, 3, 4]


def test_every_shipped_file_is_read() -> None:
    assert all(read_yaml(path).data for path in (ROOT / "configs").rglob("*.yaml"))


def test_a_file_that_cannot_be_read_is_a_typed_error(tmp_path: Path) -> None:
    for path, reason in (
        (tmp_path / "none.yaml", "No such file or directory"),
        (tmp_path, "Is a directory"),
        (Path("/dev/zero"), "larger than 1048576 bytes"),
        (Path("a\0b"), "null"),
    ):
        with pytest.raises(ConfigError, match=reason):
            read_yaml(path)


def test_no_other_module_reads_yaml() -> None:
    """Each loader of its own would need these limits again; writing needs none."""
    users = {
        str(path.relative_to(ROOT))
        for package in (
            "arbiter",
            "clients",
            "reasoner",
            "runner",
            "schemas",
            "sidecars",
            "testing",
        )
        for path in (ROOT / package).rglob("*.py")
        if re.search(
            r"^\s*(from yaml|(import|from) ruamel)\b|(?<![.\w])yaml\.(?!safe_dump\b)\w",
            path.read_text(encoding="utf-8"),
            re.MULTILINE,
        )
    }
    assert users == {"schemas/yamltext.py"}


WORDS = st.sampled_from(
    ["a: ", "gpu: ", "sensors: ", "hal: ", "- ", "? ", ": ", "[", "]", "{", "}", ",", "\n", "\n  ",
    "&a ", "*a ", "<<: ", "!!timestamp ",
     "!!binary ", "!!int ", "!!set ", "!!omap ", "!!merge ", "! ", "!x ", "!!null ", "~", "1", "x",
     "'", '"', "|\n", ">-\n", "=", "%", "--- ",
     "... ", "0x", "1:1", ".nan", "2026-01-02", "1e999", "# "]
)  # fmt: skip


@given(st.lists(WORDS | st.text(max_size=4), max_size=30).map("".join))
def test_no_text_raises_anything_but_a_typed_error(text: str) -> None:
    for load in (parse_yaml, load_config, load_robot, parse_manifest):
        try:
            load(text, "x.yaml")
        except (ConfigError, ManifestError) as error:
            str(error).encode()


def test_a_hostile_text_of_full_size_ends_soon() -> None:
    """Quadratic work would need hours; the limit is generous towards busy machines. Regression: a
    value under a repeated key was walked again, which hung on nested aliases."""
    began = time.process_time()
    for text in (
        "[" * TEXT_MAX_BYTES,
        "a: 1" + ":5" * 500_000,
        "a: '" + "x" * 1_000_000,
        "1" * TEXT_MAX_BYTES,
        TWICE,
    ):
        said(text)
    assert time.process_time() - began < 60
