"""The simulated scene: compiles, follows its seed, tells the truth, and its cameras measure."""

import math
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path

import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)

import numpy as np

from tests.support.tabletop import NAMES
from vram_arbiter.runner.robots.so101 import so101
from vram_arbiter.runner.sim.arm_env import ArmEnvironment
from vram_arbiter.runner.sim.config import ARM_JOINTS, REST_POSE, SceneConfig
from vram_arbiter.runner.sim.env import SimEnv
from vram_arbiter.runner.sim.layout import make_layout
from vram_arbiter.runner.sim.navigate import standoff_pose
from vram_arbiter.runner.sim.robot import EpisodeVideo
from vram_arbiter.runner.sim.worlds import so101_world
from vram_arbiter.schemas.errors import ConfigError, EnvironmentFailed

pytestmark = pytest.mark.heavy

SCENE_FILE = Path(__file__).parents[3] / "configs" / "scenes" / "tabletop.yaml"


@pytest.fixture
def scene_3() -> Iterator[SimEnv]:
    with SimEnv() as one:
        one.reset(3)
        yield one


def test_scene_file_says_the_defaults() -> None:
    written, built_in = SceneConfig.load(SCENE_FILE).model_dump(), SceneConfig().model_dump()
    assert written.pop("timestep_s") == pytest.approx(built_in.pop("timestep_s"))
    assert written == built_in


CAMERA = (
    "{parent: %s, width_px: 64, height_px: 48, fovy_deg: 43.0, pos_m: [0, 0, 1], look_at_m: [1, 0, "
    "0]}"
)


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("cameras: [unclosed\n", r"scene.yaml:2:1: not valid YAML"),
        ("- a list\n", r"scene.yaml"),
        ("object_count: 3\ntimestep_s: 0\n", r"scene.yaml:2: timestep_s"),
        ("timestep_s: 0.1\n", r"scene.yaml:1: timestep_s"),  # not one step in a control period
        ("timestep_s: 0.0025\n", r"scene.yaml:1: timestep_s: .*a whole number of steps, not 13.33"),
        ("table_edge_x_m: .nan\n", r"scene.yaml:1: table_edge_x_m"),
        ("object_conut: 3\n", r"scene.yaml:1: object_conut: unknown key.*object_count"),
        (f"cameras:\n  front: {CAMERA % 'moon'}\n", r"scene.yaml:2: cameras.front.parent"),
    ],
)
def test_mistakes_in_a_scene_file_are_named_by_line(tmp_path: Path, text: str, said: str) -> None:
    """Regression: they ended the simulator with a traceback, and an unsuitable time step changed
    the speed of time."""
    file = tmp_path / "scene.yaml"
    file.write_text(text, encoding="utf-8")
    with pytest.raises(ConfigError, match=said):
        so101_world(file)
    with pytest.raises(ConfigError, match="cannot be read"):
        so101_world(tmp_path / "none.yaml")


def test_a_scene_without_an_overview_is_filmed_by_another_camera(tmp_path: Path) -> None:
    """Regression: `--video` took the `overview` camera for granted."""
    file = tmp_path / "scene.yaml"
    file.write_text(f"cameras:\n  side: {CAMERA % 'world'}\n", encoding="utf-8")
    world = so101_world(file)
    assert (EpisodeVideo(world).camera, world.cameras) == ("side", ())
    assert EpisodeVideo(so101_world(None)).camera == "overview"


def test_a_scene_whose_objects_do_not_fit_is_the_environments_failure() -> None:
    """Regression: it ended the simulator with a traceback."""
    crowded = SimEnv(SceneConfig(object_count=8, zone_half_width_m=0.05))
    with pytest.raises(EnvironmentFailed, match=r"the scene of seed 3 cannot be set up: 8 objects"):
        ArmEnvironment(crowded, so101(simulated=True)).reset(3)


@pytest.mark.parametrize("seed", range(20))
def test_layout_has_distractors_of_the_targets_colour_and_shape(seed: int) -> None:
    config = SceneConfig()
    layout = make_layout(seed, config)
    names = [o.name for o in layout.objects]
    assert layout == make_layout(seed, config)
    assert len(set(names)) == config.object_count
    assert set(names) <= set(NAMES)
    colour, shape = layout.target.split()
    assert any(o.colour == colour and o.shape != shape for o in layout.objects)
    assert any(o.shape == shape and o.colour != colour for o in layout.objects)
    for i, a in enumerate(layout.objects):
        for b in layout.objects[i + 1 :]:
            assert math.dist((a.x_m, a.y_m), (b.x_m, b.y_m)) >= config.object_spacing_m


def test_layout_refuses_what_it_does_not_know() -> None:
    with pytest.raises(ValueError, match="color"):
        make_layout(0, SceneConfig(), names=("pink cube",))
    with pytest.raises(ValueError, match="differ"):
        make_layout(0, SceneConfig(), names=("red cube", "red cube"))


def test_same_seed_same_pixels_and_same_motion(scene_3: SimEnv) -> None:
    def play(one: SimEnv) -> tuple[np.ndarray, list[float]]:
        one.reset(5)
        for index in range(10):
            one.step([a + 0.02 * index for a in REST_POSE], (0.1, 0.05, 0.1))
        return one.render("front"), list(one.joint_state().values())

    image, joints = play(scene_3)
    again, joints_again = play(scene_3)
    assert np.array_equal(image, again)
    assert joints == joints_again
    assert image.shape == (360, 480, 3)
    assert image.dtype == np.uint8
    assert image.std() > 10


def test_all_objects_show_from_the_start(scene_3: SimEnv) -> None:
    for seed in range(6):
        scene_3.reset(seed)
        seen = scene_3.seen_objects("front")
        assert set(seen) == {o.name for o in scene_3.layout.objects}
        assert all(s.pixels > 80 for s in seen.values())


def test_middle_of_a_box_lands_on_the_object(scene_3: SimEnv) -> None:
    for seed in range(6):
        scene_3.reset(seed)
        model = scene_3.camera_model("front")
        assert (model.fixed, scene_3.camera_model("wrist").fixed) == (True, False)
        for name, seen in scene_3.seen_objects("front").items():
            x0, y0, x1, y1 = seen.box
            point = model.ground_point((x0 + x1) / 2, (y0 + y1) / 2)
            assert (
                math.dist(point[:2], scene_3.ground_truth().objects[name].position_base[:2]) < 0.015
            )


def test_standing_still_holds_nothing_and_moves_nothing(scene_3: SimEnv) -> None:
    before = scene_3.ground_truth()
    for _ in range(30):
        scene_3.step(None)
    after = scene_3.ground_truth()
    assert after.held is None
    for name, truth in before.objects.items():
        assert math.dist(truth.position_map, after.objects[name].position_map) < 0.001
    assert list(scene_3.joint_state()) == list(ARM_JOINTS)


def test_arm_at_rest_clears_the_objects_when_the_base_stands_before_them(scene_3: SimEnv) -> None:
    for name, truth in scene_3.ground_truth().objects.items():
        pose = standoff_pose(truth.position_map[:2], scene_3.config)
        scene_3.place((pose.x_m, pose.y_m, pose.yaw_rad), REST_POSE)
        scene_3.step(None)
        assert scene_3.ground_truth().objects[name].touching_fingers == 0


@pytest.mark.parametrize("bad", [[0.0] * 5, [math.nan] * 6, [math.inf] * 6])
def test_bad_arm_targets_move_nothing(scene_3: SimEnv, bad: list[float]) -> None:
    before = scene_3.time_s
    with pytest.raises(ValueError, match="finite"):
        scene_3.step(bad)
    with pytest.raises(KeyError):
        scene_3.step({"shoulder_pan": 0.0})
    with pytest.raises(ValueError, match="base velocity"):
        scene_3.step(None, (0.0, math.nan, 0.0))
    assert scene_3.time_s == before


SERVO_END_RAD = 1.91986  # of the shoulder's pan, by the wheel's MJCF


def test_targets_are_clipped_to_the_servos_range(scene_3: SimEnv) -> None:
    for _ in range(60):
        scene_3.step([9.0, *REST_POSE[1:]])
    assert scene_3.joint_state()["shoulder_pan"] <= SERVO_END_RAD + 0.02


def test_an_env_without_reset_says_so() -> None:
    with pytest.raises(RuntimeError, match="reset"):
        _ = SimEnv().target
