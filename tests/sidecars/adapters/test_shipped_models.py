"""The shipped detector and scene VLM on scenes that their training never saw, through the adapters
that serve them."""

import random
from importlib.util import find_spec

import pytest

from tests.support.paths import CONFIGS
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.sidecar import DetectOp, QueryOp
from vram_arbiter.sidecars.adapters.choose import make_adapter
from vram_arbiter.sidecars.adapters.scripted_pick import ScriptedPickAdapter
from vram_arbiter.sidecars.weights import resolve

pytest.importorskip("mujoco")
from tests.support.tabletop import NAMES, photo, run_expert
from training import record_counter
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.expert import GrabExpert
from vram_arbiter.runner.sim.kinematics import ArmKinematics
from vram_arbiter.runner.sim.tasks import stand_before

pytestmark = pytest.mark.heavy

UNSEEN = pytest.mark.parametrize(
    "scenes", [range(900, 902), pytest.param(range(900, 906), marks=pytest.mark.nightly)]
)
"""Seeds. Each scene costs seconds of a core: a usual run plays two."""


def adapter_of(skill: str):
    manifest = load_manifest(CONFIGS / "rskills" / skill / "rskill.yaml")
    adapter = make_adapter(manifest, resolve(str(manifest.weights_uri), CONFIGS))
    adapter.prepare()
    adapter.load("cpu")
    return adapter


@UNSEEN
def test_the_detector_finds_the_target_and_turns_down_the_absent(scenes: range):
    adapter = adapter_of("so101-detector")

    def found(image: bytes, query: str) -> list[dict]:
        return adapter.run(DetectOp(op="detect", image=image, query=query))["detections"]

    alarms = 0
    with SimEnv() as env:
        for seed in scenes:
            env.reset(seed)
            image, truth = photo(env, "front"), env.seen_objects("front")[env.target].box
            best = max(found(image, f"the {env.target}"), key=lambda one: one["score"])["box"]
            for axis in (0, 1):
                off = (best[axis] + best[axis + 2] - truth[axis] - truth[axis + 2]) / 2
                assert abs(off) < 8, f"seed {seed}: {env.target}"
            there = {thing.name for thing in env.layout.objects}
            absent = [name for name in NAMES if name not in there]
            alarms += sum(bool(found(image, name)) for name in absent[::5])
    assert alarms < len(scenes)  # of three times as many; the model card tells how often


@UNSEEN
def test_the_scene_vlm_tells_held_from_empty_and_from_another(scenes: range):
    adapter, wrong = adapter_of("so101-scene-vlm"), []

    def expect(word: str, name: str, env: SimEnv) -> None:
        question = f"Has the robot gripper grasped the {name}?"
        op = QueryOp(op="query", image=photo(env, "wrist"), question=question, max_new_tokens=32)
        if not (answer := adapter.run(op)["answer"]).startswith(word):
            wrong.append(f"{name}: {answer}")

    with SimEnv() as env:
        kinematics = ArmKinematics(env.config)
        for seed in scenes:
            env.reset(seed)
            target, other = env.layout.objects[0].name, env.layout.objects[1].name
            stand_before(env, target, random.Random(seed))
            expect("No", target, env)
            assert run_expert(env, GrabExpert(env, kinematics, target)), "choose another seed"
            expect("Yes", target, env)
            expect("No", other, env)
    # three questions each; the card gives 98 % over all, 95 % while another one of the same color
    # is held
    assert len(wrong) <= len(scenes) // 3, wrong


@UNSEEN
def test_the_pandas_scene_vlm_tells_held_from_empty_and_from_another(scenes: range):
    pytest.importorskip("mink")
    if find_spec("robosuite") is None:
        pytest.skip("needs robosuite's files: .ci/setup full")
    adapter, wrong = adapter_of("panda-scene-vlm"), []
    manifest = load_manifest(record_counter.MANIFEST)
    world = record_counter.panda_world(None)
    env = world.arm

    def expect(word: str, question: str) -> None:
        op = QueryOp(op="query", image=photo(env, "wrist"), question=question, max_new_tokens=32)
        if not (answer := adapter.run(op)["answer"]).startswith(word):
            wrong.append(f"{question} {answer}")

    grasped = "Has the robot gripper grasped the {}?"
    for seed in scenes:
        for skill in (record_counter.missing(random.Random(seed), manifest), manifest):
            world.reset(seed)
            target, other = env.layout.objects[0].name, env.layout.objects[1].name
            expect("The gripper is empty", "What is the gripper holding?")
            record_counter.stand_before(env, target, random.Random(seed))
            for action in record_counter.pick(world, skill, ScriptedPickAdapter(skill), target):
                world.step(action)
            held = env.held_object()
            expect("Yes" if held == target else "No", grasped.format(target))
            expect("Yes" if held == other else "No", grasped.format(other))
        assert held == target, "choose another seed"
    # six questions each; the card gives 98 % over all, 92 % while something is held: shapes of one
    # color are mixed up
    env.close()
    assert len(wrong) <= len(scenes) // 2, wrong


def test_the_shipped_models_are_small():
    """They are in the wheel and in the repository."""
    sizes = {
        folder.name: sum(file.stat().st_size for file in folder.iterdir())
        for folder in (CONFIGS / "models").iterdir()
        if folder.is_dir()
    }
    assert len(sizes) == 5
    assert max(sizes.values()) < 8_000_000
