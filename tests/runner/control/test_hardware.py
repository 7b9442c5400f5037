"""The loop on a robot: what reaches the motors, what is withheld and why, and how it begins and
ends. Time moves only when told.
"""

import asyncio
import threading
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import pytest

from tests.runner.manual_clock import ManualClock
from tests.runner.small_robots import FedCamera, Nod, Twin, moving, twin_runner
from vram_arbiter.runner.control.clock import SystemClock
from vram_arbiter.runner.control.skill_slot import WITHHELD_IN_A_ROW_MAX
from vram_arbiter.runner.protocols import DeadlinePolicy, Goal, Hold, SafetyGate, Skill, SkillEnded
from vram_arbiter.runner.robots.hardware import (
    FIRST_DATA_SLICE_S,
    FIRST_STATE_TRIES,
    HardwareRunner,
)
from vram_arbiter.runner.safety.gate import RobotGate
from vram_arbiter.runner.safety.ranges import JointRanges
from vram_arbiter.runner.sensors import Feed
from vram_arbiter.runner.skills.base import SkillState
from vram_arbiter.runner.skills.trajectory import FollowJointTrajectory
from vram_arbiter.schemas.errors import (
    BadRequest,
    Cancelled,
    EstopRequested,
    FrameStale,
    LimitExceeded,
    ModelError,
    RobotFault,
    StateStale,
)
from vram_arbiter.schemas.manifest import load_manifest
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.world import SensorFrame, WorldState

CONFIGS = Path(__file__).parents[3] / "configs/rskills"
PERIOD_S = 1 / 30
MakeRunner = Callable[..., HardwareRunner]


@pytest.fixture
def twin(clock: Any) -> Twin:
    return Twin(clock)


@pytest.fixture
def front(clock: Any) -> FedCamera:
    return FedCamera("front", clock)


@pytest.fixture
def make_runner(clock: Any, twin: Twin) -> MakeRunner:
    def build(cameras: Sequence[FedCamera] = (), **options: Any) -> HardwareRunner:
        return twin_runner(twin, *cameras, clock=clock, **options)

    return build


@pytest.fixture
def started(make_runner: MakeRunner) -> MakeRunner:
    def begin(*args: Any, **options: Any) -> HardwareRunner:
        runner = make_runner(*args, **options)
        runner.activate()
        return runner

    return begin


@pytest.fixture
def nod(navigate_manifest: Any) -> Callable[..., Nod]:
    def active(**options: Any) -> Nod:
        skill = Nod(load_manifest(navigate_manifest), **options)
        skill.state = SkillState.ACTIVE
        return skill

    return active


def tick(runner: HardwareRunner, clock: Any, times: int = 1) -> Any:
    for _ in range(times):
        result = runner.tick()
        clock.advance(PERIOD_S)
    return result


def begin(runner: HardwareRunner, skill: Nod, **goal: Any) -> list[SkillEnded]:
    ended: list[SkillEnded] = []
    runner.begin_skill(skill, Goal("g", "vram-arbiter/nod", **goal), ended.append)
    return ended


def test_a_skill_sees_cameras_and_moves_the_motors(
    started: MakeRunner, twin: Twin, front: FedCamera, nod: Any, clock: Any
) -> None:
    seen: list[WorldState] = []
    runner = started([front])
    ended = begin(runner, nod(cameras=("front",), steps=3, on_step=seen.append))
    result = tick(runner, clock)
    assert result.action_applied
    assert twin.applied[0].joint_names == ("wrist_flex",)
    assert seen[0].image_frames["front"].data == bytes([255, 0, 0, 0, 0, 255])  # inline, untouched
    assert seen[0].diagnostics == {"front": "ok", "joint_state": "ok"}
    tick(runner, clock, 3)
    on_time = {"late_starts_ms": {"p50": 0.0, "p99": 0.0, "max": 0.0}}
    assert ended == [SkillEnded({"ticks": 3, "withheld": 0, "clamped": 0, **on_time, "nods": 3})]
    assert len(twin.applied) == 3
    assert not tick(runner, clock).action_applied  # without a skill nothing is sent
    runner.deactivate()
    assert twin.story == ["connect", "disconnect"]


def test_what_a_skill_cannot_carry_out_is_withheld_and_fails_the_goal_if_it_lasts(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    """A tool step that the arm cannot reach is as good as one that the gate forbids."""
    runner = started()
    skill = nod()
    skill._step = lambda world: Hold("the hand stops 9 mm short", withheld=True)
    ended = begin(runner, skill)
    result = tick(runner, clock)
    assert not result.action_applied
    assert result.safety_violations == ("the hand stops 9 mm short",)
    tick(runner, clock, WITHHELD_IN_A_ROW_MAX)
    assert isinstance(ended[0].error, ModelError)
    assert ended[0].data["withheld"] == WITHHELD_IN_A_ROW_MAX
    assert not twin.applied


class Slide:
    """Kinematics of an arm whose tool is as many meters ahead as its elbow has rad."""

    gripper_lever_m = 0.1

    def points(self, joints: Mapping[str, float]) -> dict[str, tuple[float, float, float]]:
        return {"tool": (joints["elbow_flex"], 0.0, 0.0)}


def test_withheld_actions_are_reported_by_their_first_cause(
    started: MakeRunner, twin: Twin, clock: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: a trajectory that left the workspace by 2 mm failed as too fast: its targets
    moved on while the arm stood still, and the error had the last cause. The log said nothing.
    """
    manifest = load_manifest(CONFIGS / "so101-move/rskill.yaml")
    box = SafetyEnvelope(workspace_box_max_xyz=(0.21, 1.0, 1.0))
    own = RobotGate(
        twin.description,
        rate_hz=30.0,
        kinematics=Slide(),
        envelopes={"safety": box},
        now_ns=clock.now_ns,
    )
    runner = started(make_gate=lambda skill: own)
    twin.send_action(moving(elbow_flex=0.0))
    clock.advance(5.0)
    skill = FollowJointTrajectory(manifest, own.limits, period_s=PERIOD_S)
    points = [{"positions": [0.6], "time_from_start": {"sec": 3}}]
    params = {"trajectory": {"joint_names": ["elbow_flex"], "points": points}}
    asyncio.run(skill.start(Goal("g", manifest.name, params=params)))
    ended: list[SkillEnded] = []
    runner.begin_skill(skill, Goal("g", manifest.name), ended.append)
    with caplog.at_level("WARNING", "vram_arbiter.runner.control.withheld"):
        tick(runner, clock, 60)
    (error,) = (end.error for end in ended)
    assert isinstance(error, ModelError)
    assert "the first because: the tool at (0.213, 0.000, 0.000) m is 3 mm outside" in str(error)
    assert list(error.details["causes"].values()) == [WITHHELD_IN_A_ROW_MAX]
    began, over = (record.getMessage() for record in caplog.records)
    assert began.startswith("goal g: actions are withheld: the tool at (0.21")
    assert over.startswith("goal g: the goal ends after 15 withheld: 15 × the tool at")


def test_one_line_says_that_actions_pass_again(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any, caplog: pytest.LogCaptureFixture
) -> None:
    runner = started(deadline_policy=DeadlinePolicy.DROP)
    slow = iter([True, False, True, True, True] + 20 * [False])
    begin(runner, nod(on_step=lambda world: clock.advance(2 * PERIOD_S) if next(slow) else None))
    with caplog.at_level("WARNING", "vram_arbiter.runner.control.withheld"):
        tick(runner, clock, 9)
    assert [record.getMessage() for record in caplog.records] == [
        "goal g: actions are withheld: it came too late",
        "goal g: actions pass again after 1 withheld: 1 × it came too late",
        "goal g: actions are withheld: it came too late",
        "goal g: actions pass again after 3 withheld: 3 × it came too late",
    ]


@pytest.mark.parametrize("cause", ["hangs", "ends", "is not there"])
def test_a_stale_camera_withholds_and_fails_the_goal_if_it_lasts(
    started: MakeRunner, twin: Twin, front: FedCamera, nod: Any, clock: Any, cause: str
) -> None:
    runner = started([front])
    skill = nod(cameras=("rear",) if cause == "is not there" else ("front",))
    ended = begin(runner, skill)
    if cause != "is not there":
        tick(runner, clock, 3)
    front.always = False
    if cause == "ends":
        front.feed.end("end of file")
    clock.advance(0.2)
    asked, sent = skill.taken, len(twin.applied)
    result = tick(runner, clock)
    assert not result.action_applied
    assert "is stale" in result.safety_violations[0]
    assert not ended
    tick(runner, clock, 40)
    # neither asked nor moved, not even once
    assert (skill.taken, len(twin.applied)) == (asked, sent)
    assert isinstance(ended[0].error, FrameStale)
    assert {"hangs": "ms old", "ends": "end of file", "is not there": "no such camera"}[
        cause
    ] in str(ended[0].error)
    assert len([text for text in runner.slot.violations if "is stale" in text]) == 1


def test_a_camera_that_comes_back_in_time_lets_the_goal_go_on(
    started: MakeRunner, twin: Twin, front: FedCamera, nod: Any, clock: Any
) -> None:
    runner = started([front])
    ended = begin(runner, nod(cameras=("front",)))
    front.always = False
    clock.advance(0.2)
    tick(runner, clock, 5)
    assert not twin.applied
    front.always = True
    applied = [tick(runner, clock).action_applied for _ in range(4)]
    assert applied == [False, False, True, True]  # three fresh pictures in a row
    assert not ended


def test_a_camera_that_no_skill_looks_at_stops_nobody(
    started: MakeRunner, front: FedCamera, nod: Any, clock: Any
) -> None:
    runner = started([front])
    begin(runner, nod())
    front.stop()
    clock.advance(0.2)
    assert tick(runner, clock).action_applied
    assert runner.world.image_frames == {}


def test_a_lost_answer_of_the_bus_is_bridged_and_a_silent_bus_withholds(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    runner = started()
    ended = begin(runner, nod())
    tick(runner, clock)
    twin.silent = True
    assert tick(runner, clock).action_applied
    twin.silent = False
    assert tick(runner, clock).action_applied
    twin.silent = True
    clock.advance(0.1)
    result = tick(runner, clock)
    assert not result.action_applied
    assert "no answer from motor 3" in result.safety_violations[0]
    tick(runner, clock, 35)
    assert isinstance(ended[0].error, StateStale)
    assert "joint_state" in runner.world.stale


def test_what_cannot_be_sent_fails_the_goal(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    runner = started()
    ended = begin(runner, nod())
    twin.deaf = True
    assert not tick(runner, clock).action_applied
    assert isinstance(ended[0].error, RobotFault)
    assert runner.progress.state == "ended"


def test_the_gate_is_made_for_the_skill_and_what_it_refuses_is_not_sent(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    asked: list[Skill] = []

    def narrow(skill: Skill) -> SafetyGate:
        asked.append(skill)
        return JointRanges({"wrist_flex": (-0.1, 0.1)})

    runner = started(make_gate=narrow)
    skill = nod()
    begin(runner, skill)
    result = tick(runner, clock)
    assert asked == [skill]
    assert not result.action_applied
    assert "wrist_flex" in result.safety_violations[0]
    assert not twin.applied


def test_a_gate_that_cannot_be_made_gives_nobody_the_arm(started: MakeRunner, nod: Any) -> None:
    def broken(skill: Skill) -> SafetyGate:
        raise LimitExceeded("the envelope is empty")

    runner = started(make_gate=broken)
    with pytest.raises(LimitExceeded):
        begin(runner, nod())
    assert runner.progress.state == "idle"
    runner.deactivate()


def test_the_emergency_stop_comes_before_anything_else(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    told: list[str] = []
    runner = started(on_estop=told.append)
    skill = nod(on_step=lambda world: runner.request_estop("a hand is in the way"))
    ended = begin(runner, skill)
    # the step that was under way is not sent any more
    assert not tick(runner, clock).action_applied
    assert not twin.applied
    assert twin.story == ["connect", "halt"]
    assert told == ["a hand is in the way"]
    assert isinstance(ended[0].error, EstopRequested)
    assert "a hand is in the way; all joints stand still" in ended[0].error.message
    tick(runner, clock, 3)
    assert twin.story == ["connect", "halt"]
    with pytest.raises(EstopRequested):
        begin(runner, nod())
    runner.request_estop("another reason")
    assert runner.estop.details["reason"] == "a hand is in the way"


def test_a_stop_that_the_robot_latched_by_itself_is_the_runners_too(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    told: list[str] = []
    runner = started(on_estop=told.append)
    ended = begin(runner, nod())
    with pytest.raises(EstopRequested):
        twin.estop("its button")
    assert not tick(runner, clock).action_applied
    assert "its button" in told[0]
    tick(runner, clock, 3)
    assert len(told) == 1
    assert isinstance(ended[0].error, EstopRequested)
    assert runner.estop is ended[0].error


def test_a_goal_whose_actions_all_come_too_late_fails(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    """Regression: under `drop` such a goal succeeded without one command to a motor."""
    runner = started(deadline_policy=DeadlinePolicy.DROP)
    ended = begin(runner, nod(steps=100, on_step=lambda world: clock.advance(2 * PERIOD_S)))
    tick(runner, clock, 30)
    assert not twin.applied
    assert isinstance(ended[0].error, LimitExceeded)
    assert "too late" in ended[0].error.message
    assert ended[0].data["withheld"] == WITHHELD_IN_A_ROW_MAX


def test_an_action_that_was_thought_out_for_too_long_is_not_sent(
    started: MakeRunner, twin: Twin, nod: Any, clock: Any
) -> None:
    """Regression: the gate judged the state's age by its stamp and not by the clock."""
    own = RobotGate(twin.description, rate_hz=30.0, now_ns=clock.now_ns)
    runner = started(make_gate=lambda skill: own)  # under WARN: what is merely late is sent
    begin(runner, nod(on_step=lambda world: clock.advance(0.5)))
    result = tick(runner, clock)
    assert not result.action_applied
    assert "the joint state is stale: 0.50 s old" in result.safety_violations[0]
    assert not twin.applied


def test_a_tick_says_where_its_time_went(
    started: MakeRunner, twin: Twin, front: FedCamera, nod: Any, clock: Any
) -> None:
    runner = started([front])
    begin(runner, nod(on_step=lambda world: clock.advance(0.004)))
    result = runner.tick()
    assert result.inference_ms == pytest.approx(4.0)
    assert result.tick_ms == pytest.approx(4.0)
    assert (result.sensors_ms, result.world_state_ms, result.safety_ms, result.hal_ms) == (
        0,
        0,
        0,
        0,
    )


def test_a_goal_ends_after_as_many_ticks_as_it_may_take(
    started: MakeRunner, nod: Any, clock: Any
) -> None:
    runner = started()
    ended = begin(runner, nod(), max_ticks=5)
    tick(runner, clock, 8)
    assert isinstance(ended[0].error, LimitExceeded)
    assert (ended[0].data["ticks"], ended[0].data["truncated"]) == (5, True)


@pytest.mark.heavy
def test_pictures_for_others_come_in_their_colours_and_never_too_old(
    started: MakeRunner, front: FedCamera, clock: Any
) -> None:
    runner = started([front])
    assert runner.snapshot("front", 0.1).rgb.tolist() == [[[0, 0, 255], [255, 0, 0]]]
    front.always = False
    clock.advance(0.5)
    with pytest.raises(FrameStale, match="500 ms old"):
        runner.snapshot("front", 0.1)
    assert runner.snapshot("front", 1.0).camera == "front"
    with pytest.raises(BadRequest, match="choose from front"):
        runner.snapshot("rear", 1.0)


def test_it_does_not_start_on_a_camera_that_shows_nothing(
    make_runner: MakeRunner, twin: Twin, front: FedCamera, clock: Any
) -> None:
    front.always = False
    front._run_begins = lambda feed: feed.end("there is no /dev/video7")
    runner = make_runner([front])
    with pytest.raises(FrameStale, match="video7"):
        runner.activate()
    runner.deactivate()
    assert twin.story == []  # a robot that nobody sees gets no power


def test_everything_is_stopped_whatever_one_of_them_raises(
    started: MakeRunner, twin: Twin, front: FedCamera, clock: Any
) -> None:
    class Stubborn(FedCamera):
        def _run_ends(self) -> None:
            raise OSError("the driver hangs")

    runner = started([front, Stubborn("wrist", clock)])
    with pytest.raises(OSError, match="hangs"):
        runner.deactivate()
    assert twin.story == ["connect", "disconnect"]
    assert front.feed is None


class Distant(FedCamera):
    """A camera over a network: each picture arrives later than one slice of the wait for the first
    is long.
    """

    def deliver(self, feed: Feed, frame: SensorFrame) -> None:
        taken_ns = frame.stamp_monotonic_ns - round(1.5 * FIRST_DATA_SLICE_S * 1e9)
        super().deliver(feed, frame.model_copy(update={"stamp_monotonic_ns": taken_ns}))


def test_it_starts_on_a_camera_whose_pictures_take_their_time() -> None:
    clock, over = SystemClock(), threading.Event()
    twin = Twin(clock)
    far = Distant("far", clock, 60_000.0, always=False)
    runner = twin_runner(twin, far, clock=clock, max_age_ms=60_000.0, first_data_s=50.0)

    def film() -> None:
        while not over.wait(0.01):
            if far.feed is not None:
                far.show()

    thread = threading.Thread(target=film)
    thread.start()
    try:
        runner.activate()
    finally:
        over.set()
        thread.join(30)
    assert twin.story == ["connect"]
    runner.deactivate()


class Later(FedCamera):
    """A camera whose source another program starts after the runner has waited for `shows_after_s`:
    each look at it lets a minute pass.
    """

    looks = 0

    def _run_begins(self, feed: Feed) -> None:
        self.feed = feed
        feed.await_source("it has no publisher yet")

    def read_synced(self, deadline_ns: int, after_ns: int | None = None) -> SensorFrame:
        assert isinstance(self.clock, ManualClock)
        self.looks += 1
        self.clock.advance(60.0)
        if self.looks == 10:
            self.show()
        return self.slot.latest()


def test_it_waits_for_a_camera_that_another_program_has_not_started(twin: Twin) -> None:
    """Regression: a runner that came up before the publisher of a `ros2_image` camera ended after
    15 s, and came up again and again until the other program was there.
    """
    clock = ManualClock()
    camera = Later("front", clock, always=False)
    runner = twin_runner(twin, camera, clock=clock, first_data_s=15.0)
    runner.activate()
    assert camera.looks == 10
    assert twin.story == ["connect"]
    runner.deactivate()


def test_it_does_not_start_on_a_robot_that_says_nothing(
    make_runner: MakeRunner, twin: Twin
) -> None:
    twin.silent = True
    runner = make_runner()
    with pytest.raises(StateStale, match="motor 3"):
        runner.activate()
    runner.deactivate()
    assert twin.story == ["connect", "disconnect"]


def test_a_robot_whose_first_answer_is_lost_starts(
    started: MakeRunner, twin: Twin, clock: Any
) -> None:
    twin.answers_lost = FIRST_STATE_TRIES - 1
    runner = started()
    assert runner.world.stale == ()
    runner.deactivate()


def test_waiting_for_a_camera_ends_when_the_runner_is_to_stop(
    make_runner: MakeRunner, twin: Twin, front: FedCamera
) -> None:
    front.always = False
    runner = make_runner([front])
    runner.request_stop()
    with pytest.raises(Cancelled):
        runner.activate()
    runner.deactivate()
    assert twin.story == []
