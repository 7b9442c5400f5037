"""Any value at any key of the files that people write: accepted, or findings with a place. Never a
traceback."""

import json
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import yaml
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.support.deployment import load_robot
from tests.support.paths import ROOT
from vram_arbiter.schemas.config.arbiter import load_config
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.manifest import ManifestError, parse_manifest

VALUES = [
    "[]", "{}", "{a: 1}", "!!timestamp x", "!!timestamp 2020-01-01", "2020-01-01", "null", "true",
    ".nan", ".inf",
    "-1", "0", "1e400", "9" * 30, "''", "[[1]]", "[null]", "{1: 2}", "!!set {a}", "!foo x", "1:30",
    "~", "[{}]", "x",
    "!!binary aGk=", "{[]: 1}", "1.5", "'1'", "[x, x]", "!!python/object:os.system x", '"\\ud800"',
    '"\\0"',
]  # fmt: skip
ROBOT = (
    "robot_id: bench\nhal: {adapter: so101_kinematic, transport: {port: /dev/x}, params: {a: 1}}\n"
    "sensors: [{sensor_id: front, backend_params: {device: 0}, max_age_ms: 5}]\nembodiment_tags: "
    "[so101_follower]\n"
    "task: {id: grab, instruction: x, max_steps: 5, metadata: {}}\nrate_hz: 30\nthumbnail_hz: "
    "0\nsave_dir: /x\n"
    "vla: {id: act, weights_uri: rskills/x, quantization: {dtype: fp32}, extra: {}}\n"
    "safety: {max_joint_speed_factor: 0.5}\ncapabilities: {has_vision: true}\n"
)
Reader = Callable[[str], object]


def warned(text: str) -> object:
    return parse_manifest(text).warnings()


READERS: dict[str, Reader] = {
    "manifest": warned,
    "robot": lambda text: load_robot(text, "robot.yaml"),
    "daemon": lambda text: load_config(text, "arbiter.yaml"),
}
PATHS = {
    "manifest": "configs/rskills/*/rskill.yaml",
    "robot": "configs/robots/*.yaml",
    "daemon": "configs/arbiter.yaml",
}


def grab() -> Any:
    text = (ROOT / "configs/rskills/so101-grab/rskill.yaml").read_text(encoding="utf-8")
    return yaml.safe_load(text)


def places(value: Any, at: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    yield at
    items = (
        value.items()
        if isinstance(value, dict)
        else enumerate(value)
        if isinstance(value, list)
        else ()
    )
    for key, inner in items:
        yield from places(inner, (*at, key))


def yaml_text(value: Any, place: tuple[Any, ...], raw: str, at: tuple[Any, ...] = ()) -> str:
    """The value as YAML in one line, with `raw` at one place."""
    if at == place:
        return raw
    if isinstance(value, dict):
        pairs = (
            f"{json.dumps(str(key))}: {yaml_text(inner, place, raw, (*at, key))}"
            for key, inner in value.items()
        )
        return "{" + ", ".join(pairs) + "}"
    if isinstance(value, list):
        return (
            "["
            + ", ".join(yaml_text(inner, place, raw, (*at, i)) for i, inner in enumerate(value))
            + "]"
        )
    return json.dumps(value)


def cases() -> st.SearchStrategy[tuple[str, Any, tuple[Any, ...]]]:
    """A reader, a file of its kind, and a place in that."""
    texts = {
        name: [path.read_text(encoding="utf-8") for path in sorted(ROOT.glob(pattern))]
        for name, pattern in PATHS.items()
    }
    texts["robot"].append(ROBOT)
    return st.sampled_from(
        [
            (name, document, place)
            for name, found in texts.items()
            for document in map(yaml.safe_load, found)
            for place in places(document)
        ]
    )


@settings(max_examples=150, deadline=None, suppress_health_check=[HealthCheck.too_slow])
@given(case=st.deferred(cases), raw=st.sampled_from(VALUES))
def test_any_value_at_any_key_is_read_or_found_fault_with(
    case: tuple[str, Any, tuple[Any, ...]], raw: str
) -> None:
    """Regression: `model_family: []` ended in a TypeError."""
    name, document, place = case
    try:
        READERS[name](yaml_text(document, place, raw))
    except (ConfigError, ManifestError):
        pass


@pytest.mark.parametrize("raw", ["[]", "{}", "{a: 1}", "!!timestamp x", "5"])
def test_a_family_of_a_wrong_type_is_a_finding(raw: str) -> None:
    """Regression: a list or a map ended in a TypeError, a broken timestamp in a ValueError."""
    document = grab()
    with pytest.raises(ManifestError) as caught:
        parse_manifest(yaml_text(document, ("model_family",), raw))
    (problem,) = caught.value.problems
    assert problem.field == "model_family" or "cannot be read as timestamp" in problem.message
    assert problem.line


@pytest.mark.parametrize("place", [("embodiment_tags", 0), ("actions", 0), ("sensors_required", 0)])
def test_one_wrong_entry_is_one_finding(place: tuple[Any, ...]) -> None:
    """Regression: a list of one wrong entry was "must have at least 1 item" as well."""
    document = grab()
    document[place[0]] = document[place[0]][:1]
    with pytest.raises(ManifestError) as caught:
        parse_manifest(yaml_text(document, place, "[]"))
    assert len(caught.value.problems) == 1
    document[place[0]] = []
    if place[0] != "sensors_required":
        with pytest.raises(ManifestError, match="must have at least 1 item"):
            parse_manifest(yaml_text(document, ("nowhere",), ""))


def test_one_wrong_range_is_one_finding() -> None:
    document = grab()
    document["action_contract"] = {
        "dim": 3,
        "slots": [
            {"range": [2, 0], "control_mode": "joint_position", "joint_names": ["a", "b", "c"]}
        ],
    }
    with pytest.raises(ManifestError) as caught:
        parse_manifest(json.dumps(document))
    found = [
        problem
        for problem in caught.value.problems
        if problem.field.startswith("action_contract.slots[0]")
    ]
    assert len(found) == 1
