"""The emergency stop's mark: what whoever comes to look at the robot is told."""

from pathlib import Path

import pytest

from vram_arbiter.runner.safety.estop_mark import EstopMark
from vram_arbiter.schemas.errors import EstopRequested


def test_the_first_reason_is_the_one_that_is_read_later(tmp_path: Path) -> None:
    """Regression: a second `estop` overwrote the reason of the first."""
    mark = EstopMark(tmp_path / "robot-arm.estop")
    mark.leave("hand in the way")
    mark.leave("on request")  # whoever presses again only wants to be sure
    with pytest.raises(EstopRequested, match="not on request: hand in the way") as refused:
        EstopMark(tmp_path / "robot-arm.estop").refuse_if_left()
    assert refused.value.details == {"reason": "hand in the way"}
    mark.remove()
    EstopMark(tmp_path / "robot-arm.estop").refuse_if_left()


def test_a_mark_that_cannot_be_left_does_not_keep_the_stop(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    EstopMark(tmp_path / "none" / "robot-arm.estop").leave("hand in the way")
    assert "latched in this process only" in caplog.text
