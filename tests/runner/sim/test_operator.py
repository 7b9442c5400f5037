"""An operator's arm in `vram-runner sim`: it takes over and grabs; what it cannot be is refused."""

import asyncio
from importlib.util import find_spec
from pathlib import Path

import pytest

if find_spec("mujoco") is None:
    pytest.skip("needs the full install", allow_module_level=True)
pytest.importorskip("lerobot", reason="needs the sidecars extra")

from tests.support.operated import play_program
from vram_arbiter.runner.__main__ import main

pytestmark = pytest.mark.heavy
PLUGIN = Path(__file__).parents[1] / "robots" / "plugin"


@pytest.mark.nightly  # 14 s of a core, and the pace of a person
@pytest.mark.timeout(600)
def test_an_operator_takes_a_goal_over_and_grabs(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is filmed: docs/teleop.webp."""
    monkeypatch.syspath_prepend(str(PLUGIN))
    result, truth = asyncio.run(play_program(tmp_path))
    assert (result["status"], result["data"]["ended_by"]) == ("succeeded", "operator")
    assert truth["held"] == truth["target"]


@pytest.mark.parametrize(
    ("robot", "teleop", "said"),
    [
        ("so101-mobile", "", "robot.yaml:1: teleop: is missing: it names the operator's device"),
        (
            "so101-mobile",
            "teleop: {adapter: so101_leader}",
            "robot.yaml:3: teleop.adapter: unknown",
        ),
        pytest.param(
            "panda-mobile",
            'teleop: {adapter: "lerobot:so101_leader", transport: {port: /dev/null}}',
            "robot.yaml:3: teleop.adapter: lerobot has no names and units for",
            marks=pytest.mark.skipif(
                find_spec("robosuite") is None, reason="needs robosuite's files: .ci/setup full"
            ),
        ),
    ],
)
def test_a_teleoperator_that_cannot_operate_is_refused_before_anything_runs(
    robot: str, teleop: str, said: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / "robot.yaml"
    file.write_text(f"robot_id: r\nhal: {{adapter: so101_mujoco}}\n{teleop}\n", encoding="utf-8")
    endpoint = f"ipc://{tmp_path}/r.sock"
    argv = ["sim", "--no-arbiter", "--robot", robot, "--teleop", str(file), "--endpoint", endpoint]
    assert main(argv) == 2
    assert said in capsys.readouterr().err
