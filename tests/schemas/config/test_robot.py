"""`schemas.config.robot`: the deployment file, its defaults, and mistakes named by line
and field."""

import pytest

from tests.support.deployment import load_robot
from vram_arbiter.schemas.config.robot import RobotEnvironment, SensorBackend
from vram_arbiter.schemas.errors import ConfigError

SMALL = """\
robot_id: so101
hal:
  adapter: so101_mujoco
"""

FULL = """\
robot_id: so101
hal: {adapter: "lerobot:so101_follower", transport: {port: /dev/ttyACM0},
      params: {calibration: mine}}
sensors:
  - {sensor_id: wrist, backend_params: {device: 0}}
  - sensor_id: front
    backend: gstreamer
    backend_params: {pipeline: videotestsrc}
    max_age_ms: 250
    publish_to_ros: true
    publish_topic: /front/image
    publish_rate_hz: 5
task: {id: grab, scene_id: table, instruction: grab the red cube}
vla: {id: vram-arbiter/so101-grab, weights_uri: "local://configs/models/so101-grab"}
safety: {max_joint_speed_factor: 0.5, workspace_box_min_xyz: [0, -0.3, 0],
         workspace_box_max_xyz: [0.5, 0.3, 0.5]}
rate_hz: 30
thumbnail_hz: 25
deadline_overrun_policy: drop
max_ticks: 900
save_dir: out/episodes
metadata: {site: lab}
"""


def fields(text: str) -> list[tuple[int, str]]:
    with pytest.raises(ConfigError) as raised:
        load_robot(text, "robot.yaml")
    return [(found["line"], found["field"]) for found in raised.value.details["fields"]]


def test_three_lines_are_a_robot() -> None:
    robot = load_robot(SMALL, "robot.yaml")
    assert (robot.rate_hz, robot.thumbnail_hz, robot.deadline_overrun_policy) == (
        30.0,
        25.0,
        "warn",
    )
    assert (robot.sensors, robot.task, robot.vla, robot.save_dir) == ((), None, None, None)


def test_every_field_of_the_fields_files_is_read() -> None:
    robot = load_robot(FULL, "robot.yaml")
    assert [sensor.backend for sensor in robot.sensors] == [
        SensorBackend.OPENCV_THREAD,
        SensorBackend.GSTREAMER,
    ]
    assert robot.vla is not None
    assert robot.safety.max_joint_speed_factor == 0.5
    assert RobotEnvironment.model_validate(robot.model_dump(mode="json")) == robot


@pytest.mark.parametrize(
    ("text", "line", "field"),
    [
        (SMALL + "rate_hz: 0\n", 4, "rate_hz"),
        (SMALL + "rate_hz: fast\n", 4, "rate_hz"),
        (SMALL + "sensors:\n  - sensor_id: a\n    backend: v4l\n", 6, "sensors[0].backend"),
        (SMALL + "sensors:\n  - sensor_id: a\n    bakend: gstreamer\n", 6, "sensors[0].bakend"),
        (SMALL + "sensors:\n  - sensor_id: a\n    publish_to_ros: true\n", 5, "sensors[0]"),
        (SMALL + "sensors: [{sensor_id: a}, {sensor_id: a}]\n", 1, ""),
        (SMALL + "vla: {id: 'hf://owner/name'}\ntask: {id: t}\n", 4, "vla"),
        (SMALL + "vla: {id: owner/name}\n", 1, ""),
        (SMALL + "deadline_overrun_policy: ignore\n", 4, "deadline_overrun_policy"),
        ("robot_id: so101\n", 1, "hal"),
    ],
)
def test_a_mistake_is_named_by_line_and_field(text: str, line: int, field: str) -> None:
    assert fields(text) == [(line, field)]


def test_all_mistakes_are_named_at_once() -> None:
    assert fields("robot_id: ''\nhal: {adaptor: x}\nrate_hz: -1\n") == [
        (1, "robot_id"),
        (2, "hal.adapter"),
        (2, "hal.adaptor"),
        (3, "rate_hz"),
    ]
