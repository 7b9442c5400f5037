"""What a goal may execute: every kind runs or is refused as its kind says, and only on the robot it
was made for.
"""

import pytest

from vram_arbiter.runner.goals.catalogue import EXECUTABLE, Catalogue, Maker
from vram_arbiter.runner.protocols import Skill
from vram_arbiter.runner.robots.body import SIMULATED
from vram_arbiter.schemas.body import Body
from vram_arbiter.schemas.errors import UnknownSkill
from vram_arbiter.schemas.manifest import Kind, RSkillManifest

ARM = [{"kind": "joint_position", "control_mode_semantics": {"mode": "absolute"}}]
ROS = {"package": "p", "interface_type": "T", "interface_name": "/t", "default_goal_json": "{}"}
PLAYBOOK = {
    "trigger": "t",
    "body_uri": "./P.md",
    "composes_tools": ["wait"],
    "done_predicate": "d",
    "max_steps": 1,
}
WEIGHTS = {"weights_uri": "local://models/x"}
BY_KIND: dict[Kind, dict[str, object]] = {
    Kind.VLA: {"actuators_required": ARM, **WEIGHTS, "model_family": "act"},
    Kind.WAM: {"actuators_required": ARM, **WEIGHTS},
    Kind.ROS_ACTION: {"actuators_required": ARM, "ros_integration": ROS},
    Kind.ROS_SERVICE: {"actuators_required": ARM, "ros_integration": ROS},
    Kind.DETECTOR: {**WEIGHTS, "detector": {"labels": ["cube"]}},
    Kind.SEGMENTER: {**WEIGHTS, "segmenter": {"engine": "sam2_hf"}},
    Kind.VLM: WEIGHTS,
    Kind.REWARD: {**WEIGHTS, "reward": {"frame_window_s": 8, "target_fps": 1}},
    Kind.PLAYBOOK: {"playbook": PLAYBOOK, "role": "s2"},
}
REASON = {
    Kind.WAM: "nothing here runs world action models",
    Kind.DETECTOR: "a planner asks it for things",
    Kind.SEGMENTER: "nothing here serves it",
    Kind.VLM: "a planner asks it about a picture",
    Kind.REWARD: "it judges progress and moves nothing",
    Kind.PLAYBOOK: "it is a text for planners",
    Kind.VLA: "nothing here makes learned policies",
    Kind.ROS_ACTION: "nor asks a ROS 2 server",
    Kind.ROS_SERVICE: "only a robot's deployment asks",
}


def lab_skill(kind: Kind, tag: str = "any") -> RSkillManifest:
    return RSkillManifest.model_validate(
        {
            "name": f"lab/{kind}",
            "version": "1.0.0",
            "kind": kind,
            "license": "mit",
            "embodiment_tags": [tag],
            "chunk_size": 1,
            "latency_budget": {"per_chunk_ms": 1},
            "description": "d",
            "actions": ["plan" if kind is Kind.PLAYBOOK else "grasp"],
            **BY_KIND[kind],
        }
    )


def make_skill(manifest_of: RSkillManifest) -> Skill:
    raise AssertionError(f"{manifest_of.name} must not be made here")


EVERY_MAKER: dict[Kind, Maker] = dict.fromkeys(Kind, make_skill)


@pytest.mark.parametrize("kind", list(Kind))
def test_every_kind_runs_or_is_refused_with_the_way_to_use_it(kind: Kind) -> None:
    """A maker for a kind that moves nothing changes nothing: the kind decides, whoever asks."""
    with_makers, without = (
        Catalogue([lab_skill(kind)], EVERY_MAKER),
        Catalogue([lab_skill(kind)], {}),
    )
    if kind in EXECUTABLE:
        assert with_makers.find(f"lab/{kind}")[2].kind is kind
    else:
        with pytest.raises(
            UnknownSkill, match=f"is a {kind} and cannot be executed: .*{REASON[kind]}"
        ):
            with_makers.find(f"lab/{kind}")
        assert with_makers.executable() == []
    with pytest.raises(UnknownSkill, match=f"is a {kind} and cannot be executed: .*{REASON[kind]}"):
        without.find(f"lab/{kind}")
    assert any(
        "listed, not executed" in line and REASON[kind] in line for line in without.summary()
    )
    assert [listed["name"] for listed in without.as_wire()] == [f"lab/{kind}"]


def test_a_goal_for_another_robot_is_refused_whoever_asks() -> None:
    found = Catalogue(
        [lab_skill(Kind.VLA, "go2"), lab_skill(Kind.ROS_ACTION, "mobile_base")],
        EVERY_MAKER,
        body=SIMULATED,
    )
    assert [one.name for one in found.executable()] == ["lab/ros_action"]
    with pytest.raises(
        UnknownSkill, match="made for go2; this robot is so101_follower and mobile_base"
    ):
        found.find("lab/vla")
    assert len(found.as_wire()) == 2, "whoever plans hears why"
    assert Body.model_validate(found.body_as_wire()) == SIMULATED
    assert "lab/vla is not offered: it is made for go2" in "\n".join(found.summary())
