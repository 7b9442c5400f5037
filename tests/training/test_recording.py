"""Labels are the simulator's truth: they rise with a grab, and only for the thing it grabs."""

from importlib.util import find_spec

import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)

from training.record_progress import LIFTED_FROM, REACHED, TOUCHED, progress_of
from vram_arbiter.runner.sim.env import GroundTruth, ObjectTruth

pytestmark = pytest.mark.heavy

GRIPPER = (0.3, 0.0, 0.3)


def truth(held: str | None = None, *, fingers: int = 0, lift_m: float = 0.0) -> GroundTruth:
    """A red cube under the gripper, and a blue ball far off."""
    cube = ObjectTruth("red cube", GRIPPER, (0.3, 0.0, 0.2), 0.0, lift_m, fingers)
    ball = ObjectTruth("blue ball", GRIPPER, (0.3, 0.5, 0.2), 0.0, 0.0, 0)
    things = {"red cube": cube, "blue ball": ball}
    return GroundTruth(things, (0.0, 0.0, 0.0), held, "red cube")


@pytest.mark.parametrize(
    ("seen", "progress"),
    [
        (truth(), REACHED / 2),
        (truth(fingers=1), REACHED / 2),
        (truth(fingers=2), TOUCHED),
        (truth("red cube", fingers=2), LIFTED_FROM),
        (truth("red cube", fingers=2, lift_m=0.05), (1 + LIFTED_FROM) / 2),
        (truth("red cube", fingers=2, lift_m=0.5), 1.0),
    ],
)
def test_progress_is_told_by_the_truth(seen: GroundTruth, progress: float) -> None:
    assert progress_of(seen, GRIPPER, "red cube") == pytest.approx(progress)
    assert progress_of(seen, GRIPPER, "blue ball") == 0.0
