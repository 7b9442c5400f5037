"""Whoever follows a runner's goals hears of every tick in which a skill was asked, in order, and of
the end after the last one.
"""

from collections.abc import Callable
from typing import Any

import pytest

from tests.runner.small_robots import FedCamera, Nod, Twin, twin_runner
from vram_arbiter.runner.protocols import Act, Done, Goal, GoalTick, Hold, SkillEnded
from vram_arbiter.runner.skills.base import SkillState
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ModelError
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.world import Action

GOAL, NEXT = Goal("g", "test/skill"), Goal("h", "test/skill")
TWIST = Action(control_mode=ControlMode.BODY_TWIST, body_twist=((0.3, 0.0, 0.0, 0.0, 0.0, 0.1),))
NAMES = ("shoulder_pan", "shoulder_lift")


class Follower:
    """Keeps what it hears, in order."""

    def __init__(self) -> None:
        self.heard: list[tuple[str, str, Any]] = []

    def tick(self, tick: GoalTick) -> None:
        self.heard.append(("tick", tick.goal.goal_id, tick))

    def goal_ended(self, goal: Goal, ended: SkillEnded | None) -> None:
        self.heard.append(("end", goal.goal_id, ended))

    def facts(self) -> dict[str, Any]:
        return {"heard": len(self.heard)}

    @property
    def order(self) -> list[tuple[str, str]]:
        return [(what, goal_id) for what, goal_id, _ in self.heard]

    @property
    def ticks(self) -> list[GoalTick]:
        return [item for what, _, item in self.heard if what == "tick"]


class Scripted:
    manifest: Any = None
    key = "test/skill"
    cameras: tuple[str, ...] = ()
    fraction = 0.5

    def __init__(self, *script: Any) -> None:
        self.script = list(script)

    def wants_frames(self) -> bool:
        return False

    def step(self, world: Any) -> Any:
        outcome = self.script.pop(0)
        if isinstance(outcome, Exception):
            raise outcome
        return outcome


def told(*row: float) -> Act:
    return Act(
        Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=NAMES)
    )


@pytest.fixture
def sim(make_runner: Callable[..., Any]) -> tuple[Any, Follower]:
    runner, follower = make_runner(rate_hz=0), Follower()
    runner.follow(follower)
    runner.activate()
    runner.tick()
    return runner, follower


def test_each_tick_says_which_targets_are_in_force_and_the_end_comes_last(
    sim: tuple[Any, Follower],
) -> None:
    runner, follower = sim
    runner.begin_skill(
        Scripted(told(0.1, -1.0), Hold("thinking"), Act(TWIST), Done({})), GOAL, lambda _: None
    )
    results = [runner.tick() for _ in range(6)]
    assert follower.order == [("tick", "g")] * 4 + [("end", "g")]
    assert [tick.result for tick in follower.ticks] == results[:4]
    assert [tick.targets["shoulder_pan"] for tick in follower.ticks] == [0.1] * 4  # a hold keeps it
    assert follower.ticks[0].targets["elbow_flex"] == 1.05  # where the world began
    assert [tick.base_velocity for tick in follower.ticks][1:3] == [
        (0.0, 0.0, 0.0),
        (0.3, 0.0, 0.1),
    ]
    assert [tick.result.action_applied for tick in follower.ticks] == [True, False, True, False]
    assert follower.heard[-1][2].error is None
    assert runner.result().metadata["recorded"] == {"heard": 5}


def test_an_error_ends_the_goal_after_its_own_tick(sim: tuple[Any, Follower]) -> None:
    runner, follower = sim
    runner.begin_skill(Scripted(told(0.1, -1.0), ModelError("bad")), GOAL, lambda _: None)
    for _ in range(3):
        runner.tick()
    assert follower.order == [("tick", "g"), ("tick", "g"), ("end", "g")]
    assert isinstance(follower.heard[-1][2].error, ModelError)


def test_a_goal_that_is_taken_back_ends_before_the_next_one_begins(
    sim: tuple[Any, Follower],
) -> None:
    runner, follower = sim
    runner.begin_skill(Scripted(Hold("a"), Hold("b")), GOAL, lambda _: None)
    runner.tick()

    def swap() -> None:
        runner.end_skill()
        runner.begin_skill(Scripted(Hold("c")), NEXT, lambda _: None)

    runner.mailbox.post(swap)
    runner.tick()
    runner.deactivate()
    assert follower.order == [("tick", "g"), ("end", "g"), ("tick", "h"), ("end", "h")]
    assert next(item for what, _, item in follower.heard if what == "end") is None


def test_nobody_follows_unless_asked(make_runner: Callable[..., Any]) -> None:
    runner = make_runner(rate_hz=0)
    runner.activate()
    runner.tick()
    runner.begin_skill(Scripted(told(0.1, -1.0)), GOAL, lambda _: None)
    assert runner.tick().action_applied
    assert runner.result().save_dir is None


@pytest.mark.heavy  # a simulated camera's pictures: numpy
def test_a_simulator_that_is_followed_renders_all_cameras(make_runner: Callable[..., Any]) -> None:
    runner, follower = make_runner(rate_hz=0, cameras=("front", "wrist")), Follower()
    runner.follow(follower)
    runner.activate()
    runner.tick()
    runner.begin_skill(Scripted(Hold("a"), Hold("b")), GOAL, lambda _: None)
    runner.tick()
    assert sorted(follower.ticks[0].world.image_frames or {}) == ["front", "wrist"]


def test_a_robot_says_only_what_it_was_told_and_nothing_while_it_sees_nothing(
    clock: Any, navigate_manifest: Any
) -> None:
    twin, front, follower = Twin(clock), FedCamera("front", clock), Follower()
    runner = twin_runner(twin, front, clock=clock)
    runner.follow(follower)
    runner.activate()
    skill = Nod(load_manifest(navigate_manifest), cameras=("front",))
    skill.state = SkillState.ACTIVE
    runner.begin_skill(skill, GOAL, lambda _: None)
    runner.tick()
    assert list(follower.ticks[0].targets) == ["wrist_flex"]
    assert follower.ticks[0].targets["wrist_flex"] == twin.applied[0].rows[0][0]
    assert follower.ticks[0].base_velocity is None
    assert list(follower.ticks[0].world.image_frames or {}) == ["front"]
    front.always = False
    clock.advance(0.5)
    runner.tick()  # the camera is stale: the skill is not asked
    assert len(follower.ticks) == 1
    runner.deactivate()
    assert follower.order == [("tick", "g"), ("end", "g")]
