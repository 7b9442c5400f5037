"""Orientations as the numbers of a vector, and back."""

import math

import pytest

from vram_arbiter.runner.skills.rotations import matrix_of, numbers, turn
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest.vocabulary import Rotation

pytestmark = pytest.mark.heavy  # SciPy


@pytest.mark.parametrize("rotation", Rotation)
@pytest.mark.parametrize(
    "vector", [(0.0, 0.0, 0.0), (0.3, -0.2, 0.9), (3.1, 0.1, 0.0), (-3.1, 0.2, 0.1), (0, 1.6, 1.6)]
)
def test_orientations_survive_a_round_trip(
    rotation: Rotation, vector: tuple[float, float, float]
) -> None:
    matrix = turn(vector)
    written = numbers(matrix, rotation)
    assert len(written) == rotation.width
    assert matrix_of(written, rotation) == pytest.approx(matrix, abs=1e-9)


def test_a_gripper_that_points_down_has_a_steady_axis_and_angle() -> None:
    """LIBERO's grippers stand half a turn off: an axis that flips there is another state."""
    angles = [numbers(turn((math.pi + by, 0.0, 0.0)), Rotation.AXIS_ANGLE)[0] for by in (-0.1, 0.1)]
    assert angles == pytest.approx([math.pi - 0.1, math.pi + 0.1])


@pytest.mark.parametrize(
    ("values", "rotation", "said"),
    [
        ((0.0, 0.0, 0.0, 0.0), Rotation.QUAT_XYZW, "a quaternion has length 1"),
        ((1.0, 0.0, 0.0, 2.0, 0.0, 0.0), Rotation.ROT6D, "no orientation"),
    ],
)
def test_numbers_that_are_no_orientation_are_a_model_error(
    values: tuple[float, ...], rotation: Rotation, said: str
) -> None:
    with pytest.raises(ModelError, match=said):
        matrix_of(values, rotation)
