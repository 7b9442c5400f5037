"""Rules of observer.yaml: what they match, what they refuse, and samples of every event."""

import json
import re
from collections.abc import Mapping
from typing import Any

import pytest
from jsonschema import Draft202012Validator

from tests.support.paths import CONFIGS
from vram_arbiter.clients.observer.hooks.events import Delivery, environ_of, matched, sample
from vram_arbiter.schemas.config.observer import (
    NAMES,
    Hook,
    HttpConfig,
    ObserverConfig,
    load_observer,
)
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.yamltext import parse_yaml


def hook(**fields: Any) -> Hook:
    return Hook.model_validate({"name": "h", "on": "granted", "command": ["true"], **fields})


def rules(text: str) -> ObserverConfig:
    return load_observer(f"hooks:\n  - name: h\n{text}", "observer.yaml")


def test_the_shipped_example_loads_and_names_every_key() -> None:
    text = (CONFIGS / "observer.yaml").read_text()
    assert len(load_observer(text, "observer.yaml").hooks) == 2
    every = (*ObserverConfig.model_fields, *HttpConfig.model_fields, *Hook.model_fields)
    assert [name for name in every if f"{name}:" not in text] == []


def test_an_editor_accepts_the_example_and_marks_mistakes() -> None:
    """Regression: the schema wanted a list for `on`, and editors marked the example as wrong."""
    text = (CONFIGS / "observer.yaml").read_text()
    first = re.match(r"# yaml-language-server: \$schema=(\S+)\n", text)
    assert first
    reader = Draft202012Validator(json.loads((CONFIGS / first[1]).read_text()))
    example = {"hooks": parse_yaml(text, "observer.yaml").data["hooks"]}
    assert list(reader.iter_errors(example)) == []
    for mistake in ({"on": "evictd"}, {"on": ["evictd"]}, {"on": []}, {"timeout_s": 0}):
        wrong = {"hooks": [example["hooks"][0] | mistake]}
        assert list(reader.iter_errors(wrong)), mistake


@pytest.mark.parametrize(
    ("text", "problem"),
    [
        ("    on: granted", "expected one of `command` and `webhook`"),
        ("    on: granted\n    command: [a]\n    webhook: http://x/", "expected one of"),
        ("    on: evictd\n    command: [a]", "observer.yaml:3: hooks[0].on: 'evictd' is"),
        ("    on: evictd\n    command: [a]", "did you mean evicted?"),
        ("    on: granted\n    comand: [a]", "unknown key; did you mean command?"),
        ("    on: granted\n    command: [a]\n    attempts: 2", "attempts is for a webhook only"),
        ("    on: granted\n    command: sh -c x", "command"),
        ("    on: granted\n    command: []", "at least 1 item"),
        ("    on: granted\n    webhook: ftp://x/", "expected the URL of a webhook"),
        ("    on: granted\n    webhook: https://me:secret@x/", "user and fragment, got 'x/'"),
        ("    on: granted\n    webhook: http://robot/\n    headers_file: /h", "in the clear"),
        ("    on: granted\n    command: [a]\n    timeout_s: 0", "greater than 0"),
        ("    on: lost\n    command: [a]\n  - {name: h, on: lost, command: [b]}", "are named h"),
    ],
)  # fmt: skip
def test_a_mistake_is_named(text: str, problem: str) -> None:
    with pytest.raises(ConfigError) as error:
        rules(text)
    assert problem in str(error.value)


def test_an_empty_section_is_its_default_and_an_unknown_one_is_refused() -> None:
    """Regression: `hoks:` with nothing below it was accepted, and no rule ran."""
    assert load_observer("http:\nhooks:\n", "observer.yaml") == ObserverConfig()
    with pytest.raises(ConfigError, match=r"observer\.yaml:2: hoks: unknown key"):
        load_observer("http:\nhoks:\n", "observer.yaml")


def test_the_key_on_is_no_truth_value() -> None:
    """YAML 1.1 reads `on:` as `true:`, and every rule was refused."""
    assert rules("    on: evicted\n    command: [a]").hooks[0].on == ("evicted",)


@pytest.mark.parametrize(
    ("fields", "event", "name"),
    [
        ({}, {"kind": "granted", "consumer": "a"}, "granted"),
        ({}, {"kind": "ready", "consumer": "a"}, None),
        ({"on": ["lost", "revoked"]}, {"kind": "revoke_asked"}, "revoked"),
        ({"on": "verdict"}, {"kind": "verified"}, "verdict"),
        ({"on": "evicted"}, {"kind": "unloading", "asked": True}, "evicted"),
        ({"on": "evicted"}, {"kind": "unloading", "asked": False}, None),
        ({"on": "evicted"}, {"kind": "released", "was": "revoking"}, "evicted"),
        ({"on": "evicted"}, {"kind": "released", "was": "unloading"}, None),
        ({"consumer": "det*"}, {"kind": "granted", "consumer": "detector"}, "granted"),
        ({"consumer": "det*"}, {"kind": "granted", "consumer": "grab"}, None),
        ({"on": "stowaway", "consumer": "det*"}, {"kind": "stowaway"}, None),
        ({"on": "stowaway"}, {"kind": "stowaway"}, "stowaway"),
    ],
)  # fmt: skip
def test_an_event_matches(
    fields: Mapping[str, object], event: Mapping[str, object], name: str | None
) -> None:
    assert matched(hook(**fields), event) == name


def test_there_is_a_sample_of_every_event() -> None:
    hooks = {name: hook(on=name) for name in NAMES}
    assert {name: matched(one, sample(one, name).event) for name, one in hooks.items()} == {
        name: name for name in NAMES
    }


def test_variables_hold_the_plain_values() -> None:
    event = {"kind": "x", "seq": 7, "asked": True, "gone": None, "list": [1], "name": "a\0b"}
    found = environ_of(Delivery("h", "x", event, "k", 3), "ipc:///s")
    assert found == {
        "VRAM_ARBITER_ENDPOINT": "ipc:///s",
        "VRAM_ARBITER_HOOK": "h",
        "VRAM_ARBITER_HOOK_ON": "x",
        "VRAM_ARBITER_HOOK_KEY": "k",
        "VRAM_ARBITER_HOOK_DROPPED": "3",
        "VRAM_ARBITER_EVENT_KIND": "x",
        "VRAM_ARBITER_EVENT_SEQ": "7",
        "VRAM_ARBITER_EVENT_ASKED": "true",
        "VRAM_ARBITER_EVENT_NAME": "ab",
    }
