"""Manifests: valid ones of every kind load, wrong ones say where and why, whatever the file looks
like."""

from pathlib import Path

import pytest

from tests.support.paths import ROOT
from vram_arbiter.schemas.errors import ManifestInvalid
from vram_arbiter.schemas.manifest import Kind, ManifestError, load_manifest, parse_manifest

SAMPLES = sorted((Path(__file__).parent / "samples").glob("*.yaml"))
FIELD_FILES = sorted((ROOT.parent / "shared" / "reference" / "manifests").glob("*.yaml"))


def sample(name: str) -> str:
    return (Path(__file__).parent / "samples" / f"{name}.yaml").read_text(encoding="utf-8")


def findings(text: str | bytes) -> list[str]:
    with pytest.raises(ManifestError) as caught:
        parse_manifest(text)
    return str(caught.value).splitlines()


def changed(name: str, old: str, new: str) -> str:
    text = sample(name)
    assert text.count(old) == 1
    return text.replace(old, new)


@pytest.mark.parametrize("path", SAMPLES, ids=lambda path: path.stem)
def test_sample_loads_and_survives_a_round_trip(path: Path) -> None:
    manifest = load_manifest(path)
    assert manifest.kind == path.stem.split("-")[0]
    assert type(manifest).model_validate_json(manifest.model_dump_json()) == manifest


def test_samples_cover_every_kind() -> None:
    assert {path.stem.split("-")[0] for path in SAMPLES} == set(Kind)


@pytest.mark.skipif(
    not FIELD_FILES, reason="the field's own manifests do not lie beside this repository"
)
@pytest.mark.parametrize("path", FIELD_FILES, ids=lambda path: path.stem)
def test_files_of_the_field_load_unchanged(path: Path) -> None:
    assert load_manifest(path).name.startswith("OpenRAL/")


def test_values_arrive() -> None:
    manifest = parse_manifest(sample("vla"))
    assert manifest.declared_vram_gb == 4.3
    assert manifest.weights_revision == "0123456789abcdef0123456789abcdef01234567"
    assert manifest.is_commercial_use_allowed
    assert not manifest.is_scaffold_placeholder
    assert manifest.action_contract.slots is not None
    assert [slot.width for slot in manifest.action_contract.slots] == [6, 1, 3, 1, 1]
    assert manifest.warnings() == []


def test_warnings_about_what_is_missing() -> None:
    text = (
        sample("vla")
        .replace("int4: 4.3", "fp32: 4.3")
        .replace("n_action_steps: 25", "n_action_steps: 99")
    )
    text = text.replace("starting_pose: [0, ", "starting_pose: [").replace(
        'layout: "rc365"', 'layout: "home_made"'
    )
    assert [warning.field for warning in parse_manifest(text).warnings()] == [
        "min_vram_gb",
        "state_contract.layout",
        "n_action_steps",
        "starting_pose",
    ]
    text = changed("vla-act-custom", ', joint_units: "degrees"', "")
    assert [warning.field for warning in parse_manifest(text).warnings()] == [
        "action_contract.joint_units"
    ]


@pytest.mark.parametrize(
    ("name", "old", "new", "expected"),
    [
        ("detector", 'dtype: "fp16"', 'dtype: "int3"',
        "quantization.dtype: 'int3' is not one of 'fp32', 'fp16'"),
        ("detector", "  labels: [", "  labls: [", "detector.labels: is missing"),
        ("detector", "  labels: [", "  labls: [",
        "detector.labls: unknown key; did you mean labels?"),
        ("detector", 'labels: ["cup", "remote control"]', "labels: []",
        "detector.labels: must have at least 1 item, not 0"),
        ("detector", "score_threshold: 0.3", "score_threshold: 1.3",
        "detector.score_threshold: must be less than or equal to 1, not 1.3"),
        ("detector", "input_size: [640, 480]", "input_size: [640, 0]",
        "detector.input_size[1]: must be greater than 0, not 0"),
        ("detector", '"any"', '"lerobot"', "embodiment_tags[0]: 'lerobot' is not one of"),
        ("detector", '["any"]', "[]", "embodiment_tags: must have at least 1 item, not 0"),
        ("detector", "chunk_size: 1", "chunk_size: many",
        "chunk_size: must be a valid integer, not 'many'"),
        ("detector", "chunk_size: 1", "chunk_size: 0", "chunk_size: must be greater than 0, not 0"),
        ("detector", '"acme/rskill-finder"', '"finder"',
        "name: 'finder' is not a name of the form OWNER/REPOSITORY"),
        ("detector", 'version: "0.1.0"', "version: 0.1",
        "version: must be a valid string, not 0.1; put it in quotes"),
        ("detector", "fp16: 0.6", "fp99: 0.6", "min_vram_gb.fp99: 'fp99' is not one of 'fp32'"),
        ("detector", "fp16: 0.6", "fp16: 0", "min_vram_gb.fp16: must be greater than 0, not 0"),
        ("detector", "hf://acme/finder", "https://acme/finder",
        "weights_uri: 'https://acme/finder' is not a place of weights"),
        ("detector", "detector:\n  labels", "detectr:\n  labels",
        "detector: is required for kind 'detector'"),
        ("detector", 'kind: "detector"', 'kind: "detect"', "kind: 'detect' is not one of"),
        ("detector", 'kind: "detector"\n', "", "kind: is missing: one of 'vla', 'wam'"),
        ("detector", "[{modality: \"rgb\", min_width: 640, min_height: 480}]", "rgb",
        "sensors_required: must be a list, not 'rgb'"),
        ("detector", "{per_chunk_ms: 200}", "200",
        "latency_budget: must be a mapping of fields, not 200"),
        ("detector", '"Finds what it is asked for."', '"' + "x" * 501 + '"',
        "description: must have at most 500 characters"),
        ("vla", "libero_10: 0.59", "libero_11: 0.59",
        "benchmarks.libero_11: 'libero_11' is not one of"),
        ("vla", "libero_10: 0.59", "libero_10: 59",
        "benchmarks.libero_10: must be less than or equal to 1, not 59"),
        ("vla", '-small"', '"', "fallback_skill_id: must be another skill than this one"),
        ("vla", 'model_family: "pi05"', 'model_family: "pi5"', "model_family: 'pi5' is not one of"),
        ("vla", "sub/policy_postprocessor.json", "policy_preprocessor.json",
        "processors.postprocessor_uri: must be another file"),
        ("vla", "@0123abc/sub/policy_postprocessor.json", "",
        "processors.postprocessor_uri: 'hf://acme/rskill-shelf-picker' is not a file"),
        ("vla", "  resize_height: 224\n", "", "image_preprocessing.resize_height: is required"),
        ("vla", '    base_frame: "base_link"\n', "",
        "state_contract.bindings.base_frame: is required for layout 'rc365'"),
        ("vla", 'layout: "rc365"', 'layout: "gr1"',
        "state_contract.bindings: is not allowed for layout 'gr1'"),
        ("vla", ', gripper_convention: "normalized_open_unit"', "",
        "actuators_required[1].control_mode_semantics.gripper_convention: is required"),
        ("vla", ', reference_frame: "panda_link0"', "",
        "actuators_required[0].control_mode_semantics.reference_frame: is required"),
        ("vla", "range: [10, 10], discard: true", "range: [9, 10], discard: true",
        "action_contract.slots[3].range: covers value 9, which slots[2]"),
        ("vla", "    - {range: [10, 10], discard: true}\n", "",
        "action_contract.slots: must cover every value of dim; not covered: [10]"),
        ("vla", "dim: 12", "dim: 11",
        "action_contract.slots[4].range: ends at 11, beyond the 11 values of dim"),
        ("vla", "discard: true", "", "action_contract.slots[3].control_mode: is required unless"),
        ("vla", "discard: true", "terminate: true, ee: hand",
        "action_contract.slots[3].ee: is not allowed in a terminate slot"),
        ("vla", "discard: true", "discard: true, terminate: true",
        "action_contract.slots[3].terminate: is not allowed in a discarded slot"),
        ("vla", 'control_mode: "composite_mode"}',
        'control_mode: "composite_mode", rotation: rot6d}',
        "action_contract.slots[4].rotation: is not allowed for 'composite_mode'"),
        ("vla", "ee: \"panda_gripper\"}", "ee: \"panda_gripper\", gripper_convention: percent}",
        "action_contract.slots[1].gripper_convention: 'percent' is not one of"),
        ("vla", '  layout: "rc365"', '  layout: "rc365"\n  parts: [{kind: base_twist}]',
        "state_contract.parts: is not allowed beside layout"),
        ("vla", '  layout: "rc365"', '  parts: [{kind: ee_pose, ee: hand}]',
        "state_contract.parts[0].frame: is required for 'ee_pose'"),
        ("vla", '  layout: "rc365"', '  parts: [{kind: base_twist, rotation: rot6d}]',
        "state_contract.parts[0].rotation: is not allowed for 'base_twist'"),
        ("vla", "discard: true", "discard: true, ee: x",
        "action_contract.slots[3].ee: is not allowed in a discarded slot"),
        ("vla", 'ee: "panda_gripper", frame', "frame",
        "action_contract.slots[0].ee: is required for 'cartesian_delta'"),
        ("vla", '"base_x", "base_y"', '"base_x"',
        "action_contract.slots[2].joint_names: has 2 names for 3 values"),
        ("vla", "input_bounds: [-1, 1]", "input_bounds: [1, 1]",
        "action_contract.slots[0].input_bounds: must be [low, high]"),
        ("vla", "range: [6, 6]", "range: [6, 5]",
        "action_contract.slots[1].range: must be [first, last]"),
        ("vla", "0.5, 0.5, 0.5]", "0.5, 0.5]",
        "action_contract.cartesian_delta_scale: has 5 values; the cartesian_delta slots have [6]"),
        ("vla-act-custom", 'embodiment_tags: ["custom"]', 'embodiment_tags: ["any"]',
        "embodiment_extra: is only allowed with the tag 'custom'"),
        ("vla-act-custom", "required:\n  - {kind: \"joint_position\", n_dof: 6,",
        "required:\n  - {kind: \"joint_position\",",
        "actuators_required[0].n_dof: is required with the tag 'custom'"),
        ("ros_action", '"/navigate_to_pose"', '"navigate_to_pose"',
        "ros_integration.interface_name: 'navigate_to_pose' is not a full ROS name"),
        ("ros_service", '"{}"', '"[]"',
        "ros_integration.default_goal_json: must be the text of a JSON object, not a list"),
        ("ros_service", '"{}"', '"{x}"',
        "ros_integration.default_goal_json: must be the text of a JSON object:"),
        ("reward", "progress_range: [0.0, 1.0]", "progress_range: [1.0, 0.0]",
        "reward.progress_range: must be [low, high]"),
        ("reward", "check_floor: 0.4", "check_floor: 0.6",
        "reward.check_floor: must not exceed success_threshold (0.5), not 0.6"),
        ("playbook", "max_steps: 12", "max_steps: 0", "playbook.max_steps: must be greater than 0"),
        ("playbook", 'actions: ["plan"]', 'actions: ["pick"]',
        "actions: must contain 'plan' for kind 'playbook'"),
        ("vlm", 'actions: ["query"]', 'actions: ["guess"]', "actions[0]: 'guess' is not one of"),
    ],
)  # fmt: skip
def test_wrong_field_is_named(name: str, old: str, new: str, expected: str) -> None:
    text = changed(name, old, new)
    lines = [line for line in findings(text) if line.partition(" ")[2].startswith(expected)]
    assert lines, findings(text)


def test_missing_custom_block() -> None:
    text = sample("vla-act-custom")
    start = text.index("embodiment_extra:")
    text = text[:start] + text[text.index("actuators_required:") :]
    assert findings(text) == ["rskill.yaml:2: embodiment_extra: is required with the tag 'custom'"]


def test_family_without_processors() -> None:
    text = changed("vla-act-custom", 'model_family: "act"', 'model_family: "smolvla"')
    assert findings(text) == ["rskill.yaml:2: processors: is required for model_family 'smolvla'"]


def test_all_findings_come_at_once_in_the_order_of_lines() -> None:
    text = changed("vla", 'dtype: "int4"', 'dtype: "int3"').replace(
        "chunk_size: 50", "chunk_size: -1"
    )
    text += "detector: {labels: [x]}\n"
    lines = findings(text)
    assert [line.split(" ")[1] for line in lines] == [
        "quantization.dtype:",
        "chunk_size:",
        "detector:",
    ]
    numbers = [int(line.split(":")[1]) for line in lines]
    assert numbers == sorted(numbers)
    assert text.splitlines()[numbers[0] - 1].strip().startswith("dtype:")


def test_error_is_typed_and_carries_plain_data() -> None:
    with pytest.raises(ManifestInvalid) as caught:
        parse_manifest(changed("vlm", "chunk_size: 1", "chunk_size: 0"), "some.yaml")
    assert caught.value.code == "manifest_invalid"
    assert caught.value.details == {
        "source": "some.yaml",
        "fields": [{"path": "chunk_size", "problem": "must be greater than 0, not 0", "line": 11}],
    }


@pytest.mark.parametrize(
    ("content", "expected"),
    [
        ("", "rskill.yaml:1: name: is missing: a name of the form OWNER/REPOSITORY"),
        ("just words", "rskill.yaml:1: must be a mapping of fields, not 'just words'"),
        ("x" * (1 << 21), "rskill.yaml: larger than 1048576 bytes"),
    ],
)  # fmt: skip
def test_unreadable_texts_are_refused_clearly(content: str | bytes, expected: str) -> None:
    assert findings(content)[0].startswith(expected)


def test_both_mistakes_of_a_block_are_told() -> None:
    """Regression: a block told its first mistake only."""
    text = changed("reward", "check_floor: 0.4", "check_floor: 0.6")
    text = text.replace("progress_range: [0.0, 1.0]", "progress_range: [1.0, 0.0]")
    assert [line.split(" ")[1] for line in findings(text)] == [
        "reward.progress_range:",
        "reward.check_floor:",
    ]
    text = changed("vla", 'layout: "rc365"', 'layout: "rc365"\n  parts: [{kind: base_twist}]')
    text = text.replace('    base_frame: "base_link"\n', "")
    assert {line.split(" ")[1] for line in findings(text)} == {
        "state_contract.parts:",
        "state_contract.bindings.base_frame:",
    }
