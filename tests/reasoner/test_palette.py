"""What may be used: by kind, license, flag and parameter, whatever a manifest's role or a planner
says.
"""

import json
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.reasoner.palette import EXECUTABLE_KINDS, OPERATOR, Palette, Skill, skills_of
from vram_arbiter.schemas.body import UNKNOWN_BODY, Body
from vram_arbiter.schemas.errors import BadRequest, NotPermitted, UnknownSkill
from vram_arbiter.schemas.manifest import Kind, RSkillManifest, parse_manifest
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LifecycleTransition,
    LocateInView,
    QueryScene,
    StopGoal,
    WaitOn,
)

BASE = (
    'version: "1.0.0"\nembodiment_tags: ["any"]\nchunk_size: 1\n'
    'latency_budget: {per_chunk_ms: 10}\ndescription: "x"\n'
)
ARM = "actuators_required: [{kind: joint_position, control_mode_semantics: {mode: absolute}}]\n"
ROS = (
    "ros_integration: {package: p, interface_type: T, interface_name: /t,"
    ' default_goal_json: "{}"}\n'
)
WEIGHTS = "weights_uri: local://models/x\n"
BY_KIND = {
    "vla": ARM + WEIGHTS + "model_family: act\nactions: [grasp]\n",
    "wam": ARM + WEIGHTS + "actions: [grasp]\n",
    "ros_action": ARM + ROS + "actions: [navigate]\n",
    "ros_service": ARM + ROS + "actions: [release]\n",
    "detector": WEIGHTS + "detector: {labels: [cube]}\nactions: [detect]\n",
    "segmenter": WEIGHTS + "segmenter: {engine: sam2_hf}\nactions: [detect]\n",
    "vlm": WEIGHTS + "actions: [query]\n",
    "reward": WEIGHTS + "reward: {frame_window_s: 8, target_fps: 1}\nactions: [monitor]\n",
    "playbook": (
        "playbook: {trigger: t, body_uri: ./P.md, composes_tools: [locate_in_view],"
        " done_predicate: d, max_steps: 3}\nactions: [plan]\n"
    ),
}


def manifest_of_kind(
    kind: str, *, name: str = "", role: str = "", license: str = "mit"
) -> RSkillManifest:
    role = role or ("s2" if kind == "playbook" else "s1")
    head = (
        f'name: "{name or "lab/" + kind}"\nlicense: "{license}"\nrole: "{role}"\nkind: "{kind}"\n'
    )
    return parse_manifest(head + BASE + BY_KIND[kind])


def palette(
    *manifests: RSkillManifest,
    body: Body = UNKNOWN_BODY,
    allow_noncommercial: bool = False,
    **options: Any,
) -> Palette:
    skills = skills_of(manifests, body=body, allow_noncommercial=allow_noncommercial)
    return Palette(skills, body=body, **options)


@pytest.mark.parametrize("kind", [str(kind) for kind in Kind])
def test_the_kind_decides_whether_a_skill_is_executed(kind: str) -> None:
    """The defect of the field: a vlm with role s1 came into the executable palette."""
    found = palette(manifest_of_kind(kind))
    error = found.check(ExecuteRskill(rskill_id=f"lab/{kind}"))
    offered = {function["function"]["name"] for function in found.functions()}
    if kind in EXECUTABLE_KINDS:
        assert error is None
        assert f"execute_rskill__lab__{kind}" in offered
    else:
        assert isinstance(error, NotPermitted)
        assert f"of kind {kind} and cannot be executed" in str(error)
        assert offered == {"locate_in_view", "query_scene"}


def test_only_three_kinds_move_anything() -> None:
    assert {kind for kind in map(str, Kind) if kind in EXECUTABLE_KINDS} == {
        "vla",
        "ros_action",
        "ros_service",
    }
    assert set(BY_KIND) == set(map(str, Kind))


@pytest.mark.parametrize(
    ("can_locate", "can_query"), [(False, False), (False, True), (True, False), (True, True)]
)
def test_looking_and_asking_are_independent(can_locate: bool, can_query: bool) -> None:
    found = palette(manifest_of_kind("vla"), can_locate=can_locate, can_query=can_query)
    offered = {function["function"]["name"] for function in found.functions()}
    assert (
        ("locate_in_view" in offered)
        == can_locate
        == (found.check(LocateInView(query="x")) is None)
    )
    assert (
        ("query_scene" in offered) == can_query == (found.check(QueryScene(question="x")) is None)
    )


@pytest.mark.parametrize(
    ("license", "commercial"),
    [
        ("apache-2.0", True),
        ("mit", True),
        ("bsd", True),
        ("nvidia_open_model", True),
        ("permissive_research", False),
        ("nvidia_non_commercial", False),
        ("rlwrld_non_commercial", False),
        ("proprietary", False),
        ("unknown", False),
    ],
)
def test_a_licence_that_forbids_commercial_use_bars_a_skill(license: str, commercial: bool) -> None:
    skill, eye = manifest_of_kind("vla", license=license), manifest_of_kind("vlm", license=license)
    gated, open_ = palette(skill, eye), palette(skill, eye, allow_noncommercial=True)
    call = ExecuteRskill(rskill_id="lab/vla")
    assert (gated.check(call) is None) == commercial
    assert (gated.permits("lab/vlm") is None) == commercial, (
        "a model that is only asked is a model too"
    )
    assert open_.check(call) is None
    assert open_.permits("lab/vlm") is None
    assert gated.permits("lab/not-installed") is None
    if not commercial:
        assert "--allow-noncommercial" in str(gated.check(call))
        with pytest.raises(UnknownSkill, match=f"license \\({license}\\)"):
            gated.first("grasp")


def test_a_skill_without_weights_has_no_licence_of_weights() -> None:
    assert (
        palette(manifest_of_kind("ros_action", license="unknown")).check(
            ExecuteRskill(rskill_id="lab/ros_action")
        )
        is None
    )


ARM = Body(
    embodiment_tags=("so101_follower",), capabilities={"can_lift_kg": 0.25, "has_vision": True}
)


def test_a_skill_for_another_robot_is_not_offered() -> None:
    arm, dog = skill_for("so101_follower", name="lab/arm"), skill_for("go2", name="lab/dog")
    found = palette(arm, dog, body=ARM)
    offered = {f["function"]["name"] for f in found.functions()}
    assert "execute_rskill__lab__arm" in offered
    assert "execute_rskill__lab__dog" not in offered
    error = found.check(ExecuteRskill(rskill_id="lab/dog"))
    assert isinstance(error, NotPermitted)
    assert "it is made for go2; this robot is so101_follower" in str(error)
    assert found.first("grasp").id == "lab/arm"
    with pytest.raises(UnknownSkill, match="made for go2"):
        palette(dog, body=ARM).first("grasp")


def test_a_model_for_another_robot_is_not_asked_either() -> None:
    eye = manifest_of_kind("vlm")
    other = eye.model_copy(update={"embodiment_tags": ("go2",)})
    assert palette(eye, body=ARM).permits("lab/vlm") is None
    assert "made for go2" in str(palette(other, body=ARM).permits("lab/vlm"))


def skill_for(tag: str, *, name: str, needs: str = "{}") -> RSkillManifest:
    head = f'name: "{name}"\nlicense: "mit"\nkind: "vla"\ncapabilities_required: {needs}\n'
    return parse_manifest(head + BASE.replace('"any"', f'"{tag}"') + BY_KIND["vla"])


def test_a_template_is_never_executed() -> None:
    found = palette(manifest_of_kind("vla", name="TEMPLATE_ORG/x"), allow_noncommercial=True)
    assert "template" in str(found.check(ExecuteRskill(rskill_id="TEMPLATE_ORG/x")))


def test_lifecycle_only_for_nodes_on_the_list() -> None:
    """The defect of the field: any node could be switched, the safety kernel too."""
    nobody, some = (
        palette(manifest_of_kind("vla")),
        palette(manifest_of_kind("vla"), managed=frozenset({"detector"})),
    )
    call = LifecycleTransition(node="detector", transition="activate")
    assert isinstance(nobody.check(call), NotPermitted)
    assert "lifecycle_transition" not in {
        function["function"]["name"] for function in nobody.functions()
    }
    assert some.check(call) is None
    kernel = LifecycleTransition(node="safety_kernel", transition="deactivate")
    assert "may not be managed" in str(some.check(kernel))
    offered = {f["function"]["name"]: f["function"]["parameters"] for f in some.functions()}
    assert offered["lifecycle_transition"]["properties"]["node"]["enum"] == ["detector"]


def test_prompts_go_only_where_somebody_listens() -> None:
    found = palette(manifest_of_kind("vla"), topics=frozenset({OPERATOR}))
    assert found.check(EmitPrompt(target_topic="/operator", text="hello")) is None
    assert isinstance(found.check(EmitPrompt(target_topic="/cmd_vel", text="go")), NotPermitted)


def test_beside_a_goal_only_its_going_on_is_allowed() -> None:
    found = palette(manifest_of_kind("vla"), managed=frozenset({"detector"}))
    for call in (ExecuteRskill(rskill_id="lab/vla"), LocateInView(query="x"),
    QueryScene(question="x"),
                 LifecycleTransition(node="detector", transition="deactivate")):  # fmt: skip
        assert isinstance(found.check(call, goal_runs=True), NotPermitted)
    for ending in (WaitOn(), StopGoal()):
        assert found.check(ending, goal_runs=True) is None
        assert isinstance(found.check(ending), NotPermitted)


def test_a_refusal_names_what_is_offered_and_nothing_else() -> None:
    """Regression: refusals named `execute_rskill`, which is offered by the skills' own names, or
    the skills without their tools, and never `finish`; a detector was said to be asked through a
    tool that was not there.
    """
    found = palette(
        manifest_of_kind("ros_action", name="lab/go"),
        manifest_of_kind("detector"),
        can_locate=False,
    )
    offered = "choose from execute_rskill__lab__go, finish, query_scene"
    for call, goal_runs, hint in (
        (WaitOn(), False, offered),
        (ExecuteRskill(rskill_id="lab/unknown"), False, offered),
        (ExecuteRskill(rskill_id="lab/detector"), False, offered),
        (QueryScene(question="?"), True, "choose from finish, stop_goal, wait"),
    ):
        refusal = found.check(call, goal_runs=goal_runs)
        assert refusal.hint == hint
        assert "locate_in_view" not in str(refusal)


def test_parameters_are_checked_against_the_manifest() -> None:
    schema = {
        "type": "object",
        "properties": {
            "n": {"type": "integer", "minimum": 0},
            "how": {"enum": ["slow", "fast"]},
            "at": {"type": "array", "items": {"type": "number"}, "minItems": 2, "maxItems": 2},
        },
        "required": ["n"],
        "additionalProperties": False,
    }
    found = Palette((Skill("lab/a", "vla", "", ("grasp",), schema),))

    def said(text: str) -> str:
        error = found.check(ExecuteRskill(rskill_id="lab/a", goal_params_json=text))
        assert error is None or isinstance(error, BadRequest)
        return str(error or "")

    assert said('{"n": 1, "how": "slow", "at": [0, 1.5]}') == ""
    assert said("") == "", "no parameters are the skill's defaults"
    assert "goal_params.n: is required" in said('{"how": "slow"}')
    assert "goal_params.n: must be of type integer" in said('{"n": true}')
    assert "goal_params.n: must be at least 0" in said('{"n": -1}')
    assert "goal_params.how: must be one of 'slow', 'fast'" in said('{"n": 1, "how": "wild"}')
    assert "goal_params.at[1]: must be of type number" in said('{"n": 1, "at": [1, "2"]}')
    assert "at least 2 items" in said('{"n": 1, "at": [1]}')
    assert "goal_params.speed: is not a parameter" in said('{"n": 1, "speed": 9}')


JSON = st.recursive(
    st.none()
    | st.booleans()
    | st.floats(allow_nan=False, allow_infinity=False)
    | st.integers(-(1 << 63), (1 << 63) - 1)
    | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=3) | st.dictionaries(st.text(max_size=5), inner, max_size=3)
    ),
    max_leaves=6,
)


@settings(max_examples=60)
@given(
    schema=st.dictionaries(
        st.sampled_from(["type", "enum", "required", "properties", "items", "minimum", "minItems"]),
        JSON,
    ),
    value=JSON,
)
def test_a_broken_schema_never_breaks_the_check(schema: dict[str, Any], value: Any) -> None:
    found = Palette((Skill("lab/a", "vla", "", ("grasp",), schema),))
    call = ExecuteRskill(rskill_id="lab/a", goal_params_json=json.dumps({"v": value}))
    error = found.check(call)
    assert error is None or isinstance(error, BadRequest)


def test_names_under_which_a_skill_is_called() -> None:
    found = palette(
        manifest_of_kind("vla", name="lab/skill.v2"), manifest_of_kind("vla", name="lab/skill_v2")
    )
    first, second = (f["function"]["name"] for f in found.functions()[:2])
    assert first != second
    assert found.parse(first, "{}") == ExecuteRskill(rskill_id="lab/skill.v2")
    assert found.parse(second, "{}") == ExecuteRskill(rskill_id="lab/skill_v2")


def test_a_skill_that_describes_no_parameters_takes_none() -> None:
    """Regression: what no function had offered was sent to the robot."""
    found = Palette((Skill("lab/b", "vla", "", ("grasp",)),))
    with pytest.raises(BadRequest, match="takes no goal_params"):
        found.parse("execute_rskill__lab__b", {"goal_params": {"speed": 9}})
    assert found.check(found.parse("execute_rskill__lab__b", {"goal_params": {}})) is None


def test_only_role_s1_is_offered_as_an_action() -> None:
    """Regression: a skill of role s2 was offered as an action."""
    slow = manifest_of_kind("vla", name="lab/slow", role="s2")
    found = palette(slow, manifest_of_kind("vla"))
    assert list(found.executable) == ["lab/vla"]
    error = found.check(ExecuteRskill(rskill_id="lab/slow"))
    assert isinstance(error, NotPermitted)
    assert "its role is s2, and only s1 acts" in error.message


def test_the_order_of_the_palette_is_that_of_the_names() -> None:
    """The same prompt for the same skills, in whatever order their folders were read."""
    skills = [manifest_of_kind("vla", name=f"lab/{letter}") for letter in "cab"]
    offered = [function["function"]["name"] for function in palette(*skills).functions()]
    assert offered[:3] == [f"execute_rskill__lab__{letter}" for letter in "abc"]
    assert palette(*skills) == palette(*reversed(skills))


def test_a_detector_that_says_what_it_is_for_says_which_words_it_knows() -> None:
    objects = "objects: [cube]\n"
    body = WEIGHTS + "detector: {labels: [red cube, a blue one]}\nactions: [detect]\n"
    head = 'name: "lab/eye"\nlicense: "mit"\nrole: "s1"\nkind: "detector"\n'

    def unknown(more: str) -> list[str]:
        (skill,) = palette(parse_manifest(head + BASE + body + more)).skills
        return skill.unknown_words("The pink, RED cube")

    assert unknown(objects) == ["pink"]
    assert unknown("objects: [cube, open-vocabulary object]\n") == []
    assert unknown("") == [], "labels alone are what it looks for when it is asked for nothing"
