"""SimRunner: one environment step per tick, as many reset ticks as episodes, one skill at the arm,
everything else holds.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.runner.conftest import KinematicEnv, world_of
from vram_arbiter.runner.protocols import (
    Act,
    ChunkStart,
    DeadlinePolicy,
    Done,
    Goal,
    Hold,
    SkillEnded,
    SkillKey,
    StepOutcome,
)
from vram_arbiter.runner.sim.robot import sim_runner
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import (
    ConfigError,
    EnvironmentFailed,
    EstopRequested,
    Evicted,
    InternalError,
    ModelError,
)
from vram_arbiter.schemas.manifest.contracts import SafetyEnvelope
from vram_arbiter.schemas.world import Action, TickResult, WorldState

Make = Callable[..., Any]
GOAL = Goal("g", "test/skill")


def joints(*row: float) -> Action:
    names = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")[
        : len(row)
    ]
    return Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=names)


class Scripted:
    """Gives the outcomes of its script, then is done; raises the errors among them."""

    manifest: Any = None
    key = SkillKey("test/skill")
    holds_gpu = False
    cameras: tuple[str, ...] = ()
    fraction = 0.5

    def __init__(self, *script: StepOutcome | Exception) -> None:
        self.script: list[StepOutcome | Exception] = list(script)
        self.seen: list[WorldState] = []

    def wants_frames(self) -> bool:
        return bool(self.cameras)

    def step(self, world: WorldState) -> StepOutcome:
        self.seen.append(world)
        outcome = self.script.pop(0) if self.script else Done({"played": True})
        if isinstance(outcome, Exception):
            raise outcome
        return outcome

    async def start(self, goal: Goal) -> None: ...

    async def finish(self) -> None: ...

    async def release(self) -> None: ...


def play_script(
    runner: Any, script: Sequence[StepOutcome | Exception], ticks: int
) -> tuple[list[Any], list[SkillEnded]]:
    """A reset tick, then the script; the results of the ticks after it and how the skill ended."""
    ended: list[SkillEnded] = []
    runner.activate()
    runner.tick()
    runner.begin_skill(Scripted(*script), GOAL, ended.append)
    return [runner.tick() for _ in range(ticks)], ended


# -- ticks and episodes
def test_the_first_tick_resets_and_every_other_one_steps(make_runner: Make, env: Any) -> None:
    runner = make_runner(seed=7, rate_hz=0)
    runner.activate()
    first = runner.tick()
    assert (env.resets, env.steps, first.step_idx, first.action_applied) == ([7], [], None, False)
    second = runner.tick()
    assert (env.resets, len(env.steps), second.step_idx, second.action_applied) == (
        [7],
        1,
        0,
        False,
    )


Played = tuple[int | None, int, bool | None, bool | None]


def episodes_of(ticks: Sequence[TickResult]) -> list[Played]:
    """Index, steps, verdict and whether it was cut off, of every finished episode."""
    found: list[Played] = []
    steps = 0
    for tick in ticks:
        steps = 0 if tick.step_idx is None else steps + 1
        if tick.terminated or tick.truncated:
            found.append((tick.episode_idx, steps, tick.success, tick.truncated))
    return found


def test_episodes_follow_each_other_with_a_reset_each(make_runner: Make, env: Any) -> None:
    runner = make_runner(seed=3, rate_hz=0, max_steps=4, judge=lambda e: len(e.steps) == 6)
    runner.activate()
    ticks = [runner.tick() for _ in range(13)]
    assert env.resets == [3, 4, 5]
    assert [tick.tick_idx for tick in ticks if tick.step_idx is None] == [0, 5, 8]
    assert [tick.step_idx for tick in ticks] == [None, 0, 1, 2, 3, None, 0, 1, None, 0, 1, 2, 3]
    assert episodes_of(ticks) == [(0, 4, False, True), (1, 2, True, False), (2, 4, False, True)]
    assert runner.result().metadata["episodes"] == 3


def test_an_episode_without_a_judge_has_no_verdict(make_runner: Make) -> None:
    runner = make_runner(rate_hz=0, max_steps=2)
    runner.activate()
    assert episodes_of([runner.tick() for _ in range(3)]) == [(0, 2, None, True)]


def test_a_live_run_ends_when_asked(make_runner: Make, env: Any) -> None:
    runner = make_runner(rate_hz=0)
    runner.activate()
    assert runner.run(max_ticks=5).n_ticks == 5
    runner.request_stop()
    assert runner.run(max_ticks=5).n_ticks == 0
    runner.deactivate()
    runner.deactivate()
    assert env.closed


def test_stopping_within_an_episode_leaves_no_phantom(make_runner: Make, env: Any) -> None:
    runner = make_runner(seed=3, rate_hz=0, max_steps=4)
    runner.activate()
    runner.run(max_ticks=8)  # reset, 4 steps, reset, 2 steps
    runner.deactivate()
    runner.activate()  # what was broken off is played again, from its reset on, with its own seed
    assert episodes_of([runner.tick() for _ in range(5)]) == [(1, 4, None, True)]
    assert env.resets == [3, 4, 4]


@settings(deadline=None)
@given(
    lengths=st.lists(st.integers(1, 6), min_size=1, max_size=6),
    max_steps=st.none() | st.integers(1, 6),
    stop_after=st.integers(0, 40),
)
def test_every_reset_is_an_episode_that_is_played(
    lengths: list[int], max_steps: int | None, stop_after: int
) -> None:
    """Whatever ends the episodes, and wherever the run is stopped and taken up again."""
    robot = KinematicEnv()
    begun: list[int] = []  # steps of the robot at each reset

    def judge(robot: KinematicEnv) -> bool:
        while len(begun) < len(robot.resets):
            begun.append(len(robot.steps) - 1)
        return len(robot.steps) - begun[-1] >= lengths[robot.resets[-1]]

    runner = sim_runner(world_of(robot, judge), rate_hz=0, max_steps=max_steps)
    ticks: list[TickResult] = []

    def play(limit: int) -> None:
        runner.activate()
        while len(episodes_of(ticks)) < len(lengths) and len(ticks) < limit:
            ticks.append(runner.tick())
        runner.deactivate()

    play(stop_after)
    open_ones = len(robot.resets) - len(episodes_of(ticks))
    assert open_ones in (0, 1)
    play(1000)
    assert len(robot.resets) == len(lengths) + open_ones
    assert sorted(set(robot.resets)) == list(range(len(lengths)))
    assert [steps for _, steps, *_ in episodes_of(ticks)] == [
        min(n, max_steps or n) for n in lengths
    ]
    assert len(ticks) == len(robot.resets) + len(robot.steps)


def test_a_skill_loses_the_world_with_its_episode(make_runner: Make, env: Any) -> None:
    runner = make_runner(rate_hz=0, max_steps=3, judge=lambda e: len(e.steps) == 5)
    ticks, ended = play_script(runner, [Act(joints(0.1))] * 9, 3)
    assert [tick.truncated for tick in ticks] == [False, False, True]
    assert (ended[0].error.code, ended[0].error.details) == ("limit_exceeded", {"limit": "episode"})
    assert ended[0].data["steps"] == 3
    assert runner.tick().step_idx is None  # the live runner begins anew at once
    runner.begin_skill(Scripted(*[Act(joints(0.1))] * 9), GOAL, ended.append)
    runner.tick()
    assert runner.tick().terminated
    assert (ended[1].error, ended[1].data["success"]) == (None, True)
    assert env.resets == [0, 1]


def test_an_episode_may_end_with_its_skill(make_runner: Make, env: Any) -> None:
    runner = make_runner(rate_hz=0, ends_with_skill=True, judge=lambda e: len(e.steps) > 99)
    ticks, ended = play_script(runner, [Act(joints(0.1))], 2)
    assert ended[0].error is None
    assert [tick.truncated for tick in ticks] == [False, True]
    assert episodes_of(ticks) == [(0, 2, False, True)]
    runner.robot.begin_episode(41)
    runner.tick()
    assert env.resets == [0, 41]
    assert runner.tick().truncated is False  # the new episode had no skill yet


def test_a_world_that_fails_ends_the_run(make_runner: Make, env: Any) -> None:
    runner = make_runner(rate_hz=0, seed=5)
    play_script(runner, [Act(joints(0.1))], 1)
    env.fails = True
    with pytest.raises(EnvironmentFailed, match="the physics blew up"):
        runner.tick()


def test_an_arm_moves_while_its_base_drives(make_runner: Make, env: Any) -> None:
    driving = ((0.3, 0.0, 0.0, 0.0, 0.0, 0.1),)
    both = joints(0.1).model_copy(update={"body_twist": driving})
    play_script(make_runner(rate_hz=0), [Act(both)], 2)
    assert env.steps[0][0]["shoulder_pan"] == 0.1
    assert env.steps[0][1] == (0.3, 0.0, 0.1)


# -- the skill at the arm
def test_actions_reach_the_robot_in_order_and_done_ends_the_skill(
    make_runner: Make, env: Any
) -> None:
    twist = Action(
        control_mode=ControlMode.BODY_TWIST, body_twist=((0.3, 0.0, 0.0, 0.0, 0.0, 0.1),)
    )
    script = [Act(joints(0.1), chunk_index=4), Hold("thinking"), Act(twist)]
    ticks, ended = play_script(make_runner(rate_hz=0), script, 5)
    first = dict(zip(env.joints, (0.1, -1.20, 1.05, 1.35, 0.0, 0.60), strict=True))
    assert env.steps == [
        (first, None),
        (None, None),
        (None, (0.3, 0.0, 0.1)),
        (None, None),
        (None, None),
    ]
    assert [t.action_applied for t in ticks] == [True, False, True, False, False]
    assert ticks[0].chunk_index == 4
    assert [(e.data["played"], e.data["ticks"], e.error) for e in ended] == [(True, 3, None)]


def test_joints_that_an_action_leaves_out_keep_their_last_target(
    make_runner: Make, env: Any
) -> None:
    closed = joints(0.0, -1.0, 1.0, 1.0, 0.0, -0.1)
    play_script(make_runner(rate_hz=0), [Act(closed), Hold("gripped"), Act(joints(0.3, -1.1))], 4)
    assert list(env.steps[2][0].values()) == [0.3, -1.1, 1.0, 1.0, 0.0, -0.1]


@pytest.mark.parametrize("error", [Evicted("gone"), ModelError("bad")])
def test_a_typed_error_fails_the_goal_and_the_arm_holds(
    make_runner: Make, env: Any, error: Exception
) -> None:
    runner = make_runner(rate_hz=0)
    ticks, ended = play_script(runner, [Act(joints(0.1)), error], 4)
    assert [e.error for e in ended] == [error]
    assert env.steps[1:] == [(None, None)] * 3
    assert ticks[1].safety_violations
    assert runner.progress.state == "ended"


def test_a_defect_of_a_skill_does_not_take_the_loop_with_it(make_runner: Make, env: Any) -> None:
    _, ended = play_script(make_runner(rate_hz=0), [ZeroDivisionError("oops")], 3)
    assert isinstance(ended[0].error, InternalError)
    assert len(env.steps) == 3


def test_an_action_outside_the_envelope_is_withheld_and_recorded(
    make_runner: Make, env: Any
) -> None:
    runner = make_runner(rate_hz=0)
    ticks, ended = play_script(runner, [Act(joints(3.0)), Act(joints(0.6))], 3)
    assert env.steps[0] == (None, None)
    assert env.steps[1][0]["shoulder_pan"] == 0.5
    assert [t.action_applied for t in ticks[:2]] == [False, True]
    assert "outside" in ticks[0].safety_violations[0]
    assert len(runner.slot.violations) == 2
    assert (ended[0].data["withheld"], ended[0].data["clamped"]) == (1, 1)


def test_the_gate_is_a_robots_and_each_skill_tightens_it(make_runner: Make, env: Any) -> None:
    class Careful(Scripted):
        manifest = SimpleNamespace(
            name="test/careful", envelope=SafetyEnvelope(max_joint_speed_factor=0.1)
        )

    runner = make_runner(rate_hz=0)
    play_script(runner, [Act(joints(0.2))], 2)
    assert env.joints["shoulder_pan"] == 0.2  # 6 rad/s; the arm makes 30
    ended: list[SkillEnded] = []
    runner.begin_skill(Careful(Act(joints(0.4)), Act(joints(-0.3))), GOAL, ended.append)
    ticks = [runner.tick() for _ in range(3)]
    # 3 rad/s, with the tick between that sent nothing
    assert env.joints["shoulder_pan"] == pytest.approx(0.35)
    assert "is beyond 3.00 rad/s" in ticks[0].safety_violations[0]
    assert [tick.action_applied for tick in ticks] == [True, False, False]
    assert (ended[0].data["clamped"], ended[0].data["withheld"]) == (1, 1)


def test_an_envelope_that_cannot_be_kept_is_refused_before_anything_moves(
    make_runner: Make,
) -> None:
    class Boxed(Scripted):
        manifest = SimpleNamespace(
            name="test/boxed", envelope=SafetyEnvelope(workspace_box_max_xyz=(0.3, 0.3, 0.3))
        )

    runner = make_runner(rate_hz=0)
    runner.activate()
    with pytest.raises(ConfigError, match="no kinematics"):
        runner.begin_skill(Boxed(), GOAL, lambda _: None)
    runner.begin_skill(Scripted(), GOAL, lambda _: None)  # nobody has the arm


def test_speeds_are_judged_by_simulated_time(make_runner: Make, env: Any, clock: Any) -> None:
    runner = make_runner(rate_hz=0, clock=clock)
    thinks_s = iter([0.0, 5.0, 0.0])

    class Slow(Scripted):
        def step(self, world: WorldState) -> StepOutcome:
            clock.advance(next(thinks_s))  # the policy thinks, the world waits
            return super().step(world)

    ended: list[SkillEnded] = []
    runner.activate()
    runner.tick()
    runner.begin_skill(
        Slow(Act(joints(0.3)), Act(joints(-0.4)), Act(joints(-0.4))), GOAL, ended.append
    )
    ticks = [runner.tick() for _ in range(3)]
    assert [tick.action_applied for tick in ticks] == [True, True, True]
    assert env.joints["shoulder_pan"] == -0.4


def test_a_stop_that_comes_while_the_skill_decides_acts_in_this_tick(
    make_runner: Make, env: Any
) -> None:
    """The simulator applied that action and obeyed one tick later; hardware never did."""

    class Stopped(Scripted):
        def step(self, world: WorldState) -> StepOutcome:
            runner.request_estop("a hand is in the way")
            return super().step(world)

    runner = make_runner(rate_hz=0)
    ended: list[SkillEnded] = []
    runner.activate()
    runner.tick()
    runner.begin_skill(Stopped(Act(joints(0.1))), GOAL, ended.append)
    result = runner.tick()
    assert env.steps == [(None, None)]
    assert not result.action_applied
    assert isinstance(ended[0].error, EstopRequested)


def test_one_skill_at_a_time_and_taking_the_arm_back(make_runner: Make, env: Any) -> None:
    runner, ended = make_runner(rate_hz=0), []
    play_script(runner, [Act(joints(0.1))] * 10, 2)
    with pytest.raises(InternalError, match="another skill"):
        runner.begin_skill(Scripted(), GOAL, ended.append)
    runner.end_skill()
    runner.end_skill()
    runner.tick()
    assert env.steps[-1] == (None, None)
    assert ended == []


def test_a_state_that_is_not_finite_fails_closed(make_runner: Make, env: Any) -> None:
    runner, ended = make_runner(rate_hz=0), []
    runner.activate()
    runner.tick()
    runner.begin_skill(Scripted(Act(joints(0.1))), GOAL, ended.append)
    env.joints["gripper"] = float("nan")
    assert not runner.tick().action_applied
    assert isinstance(ended[0].error, InternalError)
    assert runner.world is None


def test_stopping_ends_the_skill_with_an_error(make_runner: Make) -> None:
    runner = make_runner(rate_hz=0)
    _, ended = play_script(runner, [Act(joints(0.1))] * 10, 1)
    runner.deactivate()
    assert isinstance(ended[0].error, InternalError)


def test_the_ticks_of_a_goal_join_its_trace(make_runner: Make) -> None:
    parent = "00-0af7651916cd43dd8448eb211c80319c-b7ad6b7169203331-01"
    runner = make_runner(rate_hz=0)
    runner.activate()
    runner.tick()
    runner.begin_skill(Scripted(Hold("x")), Goal("g", "r", traceparent=parent), lambda _: None)
    ticks = [runner.tick() for _ in range(3)]
    assert [tick.trace_context is not None for tick in ticks] == [True, True, False]
    assert ticks[0].trace_context["traceparent"].split("-")[1] == parent.split("-")[1]


def test_goals_and_runs_say_what_became_of_chunks_and_actions(make_runner: Make) -> None:
    runner = make_runner(rate_hz=0, seed=3)
    runner.identity = {"robot": "arm", "scene": "table"}
    script = [
        Act(joints(0.1), chunk_index=0, chunk=ChunkStart(0.9, None)),
        Act(joints(9.0), chunk_index=1, chunk=ChunkStart(0.25, True)),
        Act(joints(0.6), chunk_index=1),
        Hold("the policy thinks", standing=True),
        Act(joints(0.1), chunk_index=2, chunk=ChunkStart(0.75, False, over_budget=True)),
        Act(joints(0.1), chunk_index=3, chunk=ChunkStart(0.5, True)),
        Evicted("gone"),
    ]
    _, ended = play_script(runner, script, 7)
    counts = {
        "withheld": 1,
        "clamped": 1,
        "chunk_latency_ms": {"first": 900.0, "p50": 500.0, "p99": 745.0, "max": 750.0},
        "chunks_over_budget": 1,
        "standing_steps": 1,
        "prefetch": {"hits": 2, "misses": 1, "hit_rate": 2 / 3},
    }
    assert ended[0].data == {"ticks": 6, **counts}
    metadata = runner.result().metadata
    assert metadata.items() >= {**counts, "robot": "arm", "scene": "table", "seed": 3}.items()
    assert metadata["goals_by_skill"] == {"test/skill": 1}
    assert (metadata["rate_hz"], metadata["deadline_policy"], metadata["deadline_misses"]) == (
        0,
        "warn",
        0,
    )


def test_a_skill_without_chunks_says_nothing_of_them(make_runner: Make) -> None:
    runner = make_runner(rate_hz=0)
    _, ended = play_script(runner, [Act(joints(0.1))], 2)
    assert "prefetch" not in ended[0].data
    assert "prefetch" not in runner.result().metadata


# -- pictures
@pytest.mark.heavy
def test_frames_are_rendered_on_demand_and_reused_while_young(
    make_runner: Make, env: Any, clock: Any
) -> None:
    runner = make_runner(rate_hz=0, clock=clock, cameras=("front",))
    runner.activate()
    runner.tick()
    first = runner.snapshot("front", 0.5)
    clock.advance(0.05)
    assert runner.snapshot("front", 0.5) is first
    assert runner.snapshot("front", 0.02) is not first
    clock.advance(0.2)
    runner.tick()
    assert runner.snapshot("front", 0.5).stamp_ns == clock.now_ns()


@pytest.mark.heavy
def test_a_crowd_of_requests_for_pictures_costs_a_tick_one_picture_a_camera(
    make_runner: Make, env: Any, clock: Any
) -> None:
    """Each request that wanted a picture of this instant rendered one in the tick: sixteen of them
    made it half a second long.
    """
    runner = make_runner(rate_hz=0, clock=clock, cameras=("front", "wrist"))
    runner.activate()
    runner.tick()
    pictures = []
    for _ in range(16):
        clock.advance(0.001)
        pictures.append(runner.snapshot("front", 1e-9))
    assert all(picture is pictures[0] for picture in pictures)
    assert runner.snapshot("wrist", 1e-9) is not pictures[0]
    runner.tick()
    clock.advance(0.001)
    assert runner.snapshot("front", 1e-9) is not pictures[0]


@pytest.mark.heavy
def test_a_skill_sees_the_cameras_it_wants(make_runner: Make) -> None:
    runner, skill = make_runner(rate_hz=0, cameras=("front", "wrist")), Scripted(Hold("x"))
    skill.cameras = ("wrist",)
    runner.activate()
    runner.tick()
    runner.begin_skill(skill, GOAL, lambda _: None)
    runner.tick()
    frames = skill.seen[0].image_frames
    assert set(frames) == {"wrist"}
    assert (frames["wrist"].width, frames["wrist"].height) == (32, 24)


# -- the real simulator
@pytest.mark.heavy
def test_navigating_the_real_simulator_and_filming_it(
    tmp_path: Path, navigate_manifest: Path, run_async: Any
) -> None:
    import imageio_ffmpeg

    from vram_arbiter.runner.sim.robot import sim_runner
    from vram_arbiter.runner.sim.video import VideoRecorder
    from vram_arbiter.runner.sim.worlds import so101_world
    from vram_arbiter.runner.skills.navigate import Navigate
    from vram_arbiter.schemas.manifest import load_manifest

    world = so101_world(None)
    env, scene = world.arm, world.arm.config
    recorder = VideoRecorder(tmp_path / "episode.mp4", fps=10)
    runner = sim_runner(world, seed=1, rate_hz=0)
    runner.robot.video.recorder = recorder
    skill = Navigate(load_manifest(navigate_manifest), scene, {}, period_s=1 / 30)
    ended: list[SkillEnded] = []
    try:
        runner.activate()
        runner.tick()
        x, y, z = env.ground_truth().objects[env.target].position_base
        run_async(
            skill.start(Goal("g", "navigate", params={"target_point": {"x": x, "y": y, "z": z}}))
        )
        runner.begin_skill(skill, GOAL, ended.append)
        while not ended:
            runner.tick()
            assert runner.tick_idx < 400
        assert ended[0].error is None
        x, y, _ = env.ground_truth().objects[env.target].position_base
        assert (x, y) == pytest.approx(scene.grasp_spot_in_base_m, abs=0.03)
        model = runner.snapshot("front", 0.5).model
        assert model is not None
        box = env.seen_objects("front")[env.target].box
        seen = model.ground_point((box[0] + box[2]) / 2, (box[1] + box[3]) / 2)
        assert seen[:2] == pytest.approx((x, y), abs=0.012)
    finally:
        runner.deactivate()
        recorder.close()
    frames, seconds = imageio_ffmpeg.count_frames_and_secs(str(tmp_path / "episode.mp4"))
    assert frames == recorder.written
    assert frames >= 10
    assert seconds == pytest.approx(frames / 10, abs=0.2)


def test_a_scene_that_takes_long_to_build_misses_no_deadline(
    make_runner: Make, env: Any, clock: Any
) -> None:
    """There is no action that could come too late:

    `raise` would end every run before its first step.
    """
    build = env.reset

    def slowly(seed: int) -> None:
        clock.advance(0.8)
        build(seed)

    env.reset = slowly
    options = {"rate_hz": 10, "max_steps": 3, "clock": clock}
    runner = make_runner(**options)
    runner.deadline_policy = DeadlinePolicy.RAISE
    runner.activate()
    result = runner.run(max_ticks=8)
    assert (env.resets, result.budget_violations) == ([0, 1], 0)
