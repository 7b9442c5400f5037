"""World types: what is misshapen is refused, what is bytes survives JSON, geometry is right."""

import json
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from pydantic import ValidationError

from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.world import (
    PAYLOAD_OF_MODE,
    Action,
    CameraModel,
    DetectedObject,
    FrameEncoding,
    JointState,
    Pose,
    SensorFrame,
    TickResult,
    WorldState,
)

STAMPS = {"stamp_monotonic_ns": 1_000_000_000, "stamp_wall_ns": 2}
SIZE = {"width": 2, "height": 1}


def sensor_frame(**fields: Any) -> SensorFrame:
    return SensorFrame(**({"sensor_id": "front", "encoding": "rgb8", **STAMPS, **SIZE} | fields))


@given(st.binary(min_size=6, max_size=6))
def test_frame_bytes_survive_json_and_python(data: bytes) -> None:
    original = sensor_frame(data=data)
    assert SensorFrame.model_validate_json(original.model_dump_json()) == original
    assert SensorFrame.model_validate(json.loads(original.model_dump_json())) == original
    assert SensorFrame.model_validate(original.model_dump()) == original
    assert original.model_dump()["data"] == data


@pytest.mark.parametrize(
    "fields", [{"topic": "/front"}, {"topic": "/front", "handle": None, "data": b""}]
)
def test_frame_may_point_elsewhere(fields: dict[str, Any]) -> None:
    assert sensor_frame(**fields).data is None


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({}, "exactly one of data and topic must be set, not none"),
        ({"data": b"", "topic": ""}, "must be set, not none"),
        ({"data": b"123456", "topic": "/x"}, "not data, topic"),
        ({"handle": 7}, "handle\n.*should be None"),
        ({"topic": "/x", "encoding": "cuda_nv12"}, "encoding"),
        ({"data": b"12345"}, "rgb8 of 2 × 1 needs 6 bytes of data, not 5"),
        ({"data": b"123456", "encoding": "depth16"}, "depth16 of 2 × 1 needs 4 bytes"),
        ({"data": "not base64!"}, "must be standard base64"),
        ({"data": b"123456", "width": 0}, "greater than 0"),
        ({"data": b"123456", "colour": 1}, "Extra inputs"),
    ],
)
def test_wrong_frame_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        sensor_frame(**fields)


def test_compressed_frames_have_any_length() -> None:
    assert sensor_frame(data=b"\xff\xd8", encoding=FrameEncoding.JPEG).data == b"\xff\xd8"


def test_age_of_a_frame() -> None:
    assert sensor_frame(topic="/x").age_s(1_250_000_000) == pytest.approx(0.25)


def test_joint_state_lengths_agree() -> None:
    state = JointState(name=("a", "b"), position=(0.0, 1.0), velocity=(0, 0), stamp_ns=1)
    assert state.effort == ()
    with pytest.raises(ValidationError, match="position has 1 values for 2 joints"):
        JointState(name=("a", "b"), position=(0.0,), stamp_ns=1)
    with pytest.raises(ValidationError, match="velocity has 1 values"):
        JointState(name=("a", "b"), position=(0, 0), velocity=(0,), stamp_ns=1)
    with pytest.raises(ValidationError, match="unique"):
        JointState(name=("a", "a"), position=(0, 0), stamp_ns=1)
    with pytest.raises(ValidationError, match="finite"):
        JointState(name=("a",), position=(float("nan"),), stamp_ns=1)


def test_world_state_round_trip_and_stale_components() -> None:
    state = WorldState(
        stamp_ns=5,
        joint_state=JointState(name=("a",), position=(0.5,), stamp_ns=4),
        base_pose=Pose(xyz=(1, 2, 0), frame_id="odom"),
        base_twist=(0.1, 0, 0, 0, 0, 0.2),
        image_frames={"front": sensor_frame(data=b"123456")},
        detected_objects=(DetectedObject(label="cube", confidence=0.9, box=(0, 0, 5, 5)),),
        diagnostics={"joints": "ok", "front": "stale", "base": "error"},
    )
    assert state.stale == ("base", "front")
    assert WorldState.model_validate_json(state.model_dump_json()) == state


def test_quaternion_must_have_length_one() -> None:
    with pytest.raises(ValidationError, match="length 1"):
        Pose(xyz=(0, 0, 0), quat_xyzw=(0, 0, 0, 2), frame_id="map")


PAYLOADS: dict[str, Any] = {
    "joint_targets": [[0.0, 1.0]],
    "joint_velocities": [[0.0, 1.0]],
    "joint_torques": [[0.0, 1.0]],
    "cartesian_pose": [{"xyz": [0, 0, 0], "frame_id": "base"}],
    "cartesian_delta": [[0, 0, 0.01, 0, 0, 0]],
    "cartesian_twist": [[0, 0, 0.01, 0, 0, 0]],
    "body_twist": [[0.1, 0, 0, 0, 0, 0]],
    "foot_placements": [{"leg": "left"}],
    "gripper": [0.5],
    "dex_hand_joints": [[0.1] * 6],
    "composite_mode": [-1.0],
}


@given(st.sampled_from(list(ControlMode)), st.sets(st.sampled_from(sorted(PAYLOADS))))
def test_action_carries_exactly_the_payload_of_its_mode(
    mode: ControlMode, given_fields: set[str]
) -> None:
    fields = {"control_mode": mode, **{name: PAYLOADS[name] for name in given_fields}}
    driving = mode is ControlMode.JOINT_POSITION and "body_twist" in given_fields
    if given_fields - ({"body_twist"} if driving else set()) == {PAYLOAD_OF_MODE[mode]}:
        action = Action.model_validate(fields)
        assert len(action.rows) == 1
        assert Action.model_validate_json(action.model_dump_json()) == action
    else:
        with pytest.raises(ValidationError, match="is carried by"):
            Action.model_validate(fields)


@pytest.mark.parametrize(
    ("fields", "message"),
    [
        ({"horizon": 2}, "joint_targets has 1 rows, horizon says 2"),
        ({"joint_targets": [[0, 1], [0]], "horizon": 2}, "different lengths"),
        ({"joint_names": ["a"]}, "joint_names has 1 names for rows of 2"),
        ({"joint_targets": [[float("inf"), 0]]}, "finite"),
        ({"confidence": 1.5}, "less than or equal to 1"),
    ],
)
def test_wrong_action_is_refused(fields: dict[str, Any], message: str) -> None:
    with pytest.raises(ValidationError, match=message):
        Action.model_validate(
            {"control_mode": "joint_position", "joint_targets": [[0, 1]]} | fields
        )


def test_camera_puts_a_pixel_on_the_plane() -> None:
    looking_down = CameraModel(
        K=((100, 0, 50), (0, 100, 50), (0, 0, 1)),
        T_base_camera=((1, 0, 0, 0.2), (0, -1, 0, 0.0), (0, 0, -1, 1.0), (0, 0, 0, 1)),
    )
    assert looking_down.ground_point(50, 50) == pytest.approx((0.2, 0.0, 0.0))
    assert looking_down.ground_point(150, 50) == pytest.approx((1.2, 0.0, 0.0))
    assert looking_down.model_copy(update={"support_plane_z": 2.0}).ground_point(50, 50) is None
    level = looking_down.model_copy(
        update={"T_base_camera": ((0, 0, 1, 0), (-1, 0, 0, 0), (0, -1, 0, 1), (0, 0, 0, 1))}
    )
    assert level.ground_point(50, 50) is None
    assert level.ground_point(50, 150) == pytest.approx((1.0, 0.0, 0.0))


def test_wrong_camera_is_refused() -> None:
    unit = ((1, 0, 0, 0), (0, 1, 0, 0), (0, 0, 1, 0), (0, 0, 0, 1))
    with pytest.raises(ValidationError, match="focal lengths"):
        CameraModel(K=((0, 0, 0), (0, 0, 0), (0, 0, 1)), T_base_camera=unit)
    with pytest.raises(ValidationError, match="last row"):
        CameraModel(K=((1, 0, 0), (0, 1, 0), (0, 0, 1)), T_base_camera=(*unit[:3], (0, 0, 0, 2)))


def test_objects_are_read_as_the_field_writes_them() -> None:
    box = (0.0, 0.0, 0.0, 1.0, 1.0, 1.0)
    ours = DetectedObject(label="cube", confidence=0.9, box_3d=box, track_id="a")
    assert ours.box_3d == box
    field = DetectedObject.model_validate(
        {"label": "cube", "confidence": 0.9, "bbox_3d": box, "track_id": 7}
    )
    assert (field.box_3d, field.track_id) == (box, 7)
    assert DetectedObject.model_validate(field.model_dump()) == field
    assert DetectedObject.model_validate_json(field.model_dump_json()) == field
    for track_id in (-1, 1.5, True):
        with pytest.raises(ValidationError):
            DetectedObject.model_validate(
                {"label": "cube", "confidence": 0.9, "track_id": track_id}
            )


@pytest.mark.parametrize("name", ["tick_idx", "chunk_index", "step_idx", "episode_idx"])
def test_indices_count_from_0(name: str) -> None:
    tick = {"stamp_ns": 1, "tick_idx": 0, "tick_ms": 1.0}
    assert getattr(TickResult.model_validate(tick | {name: 0}), name) == 0
    with pytest.raises(ValidationError, match=name):
        TickResult.model_validate(tick | {name: -1})
