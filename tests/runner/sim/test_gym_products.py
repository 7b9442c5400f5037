"""Gymnasium environments whose actions and observations have parts: driven, seen, judged and
benchmarked like all others.
"""

from collections.abc import Callable
from typing import Any

import pytest

pytestmark = pytest.mark.heavy

np = pytest.importorskip("numpy")
gymnasium = pytest.importorskip("gymnasium")

from gymnasium import spaces  # noqa: E402

from vram_arbiter.runner.protocols import Act, Goal, SkillEnded, SkillKey  # noqa: E402
from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, PolicyContestant  # noqa: E402
from vram_arbiter.runner.sim.gym_config import GymConfig  # noqa: E402
from vram_arbiter.runner.sim.gym_env import GymEnv  # noqa: E402
from vram_arbiter.runner.sim.policies import Policy, PolicyPlayer, policy_of  # noqa: E402
from vram_arbiter.runner.sim.robot import sim_runner  # noqa: E402
from vram_arbiter.schemas.control import ControlMode  # noqa: E402
from vram_arbiter.schemas.errors import ConfigError, EnvironmentFailed, ModelError  # noqa: E402
from vram_arbiter.schemas.world import Action, JointState, WorldState  # noqa: E402

HAND = "tests.runner.gym_worlds:test/Hand-v0"
NAMES = ("arm.0", "arm.1", "gripper", "lamps.0", "lamps.1", "walk.0.0", "walk.0.1", "walk.1")
PICTURE = spaces.Box(0, 255, (8, 8, 3), np.uint8)
NOWHERE = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))


class Plain(gymnasium.Env[Any, Any]):
    """Takes and shows whatever it was made for, and counts what it was given."""

    def __init__(self, action: Any, observation: Any = None, seen: Any = None) -> None:
        self.action_space = action
        self.observation_space = observation or spaces.Discrete(1)
        self.seen = seen
        self.taken: list[Any] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.observation_space.seed(seed)
        return self._look(), {}

    def _look(self) -> Any:
        return self.observation_space.sample() if self.seen is None else self.seen

    def step(self, action: Any) -> tuple[Any, float, bool, bool, dict[str, Any]]:
        self.taken.append(action)
        return self._look(), 0.0, False, False, {}


if "test/Plain-v0" not in gymnasium.registry:
    gymnasium.register("test/Plain-v0", Plain)


def plain(action: Any, observation: Any = None, seen: Any = None, **config: Any) -> GymEnv:
    kwargs = {"action": action, "observation": observation, "seen": seen}
    return GymEnv(
        "test/Plain-v0", GymConfig.model_validate({"kwargs": kwargs, **config}), render=False
    )


def gate_of(env: GymEnv) -> Any:
    return env.gate(PolicyPlayer("test", env, lambda world: None))


def given(*row: float, names: tuple[str, ...] | None = None) -> Action:
    return Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=names)


# -- actions
def test_an_action_of_parts_is_one_row_with_names() -> None:
    env = GymEnv(HAND, render=False)
    env.reset(0)
    row = (0.5, -0.25, 0.9, 1.0, 0.2, -0.4, 0.1, 0.0)
    backwards = given(*reversed(row), names=tuple(reversed(NAMES)))
    allowed, problems = gate_of(env).check(backwards, NOWHERE)
    assert (allowed, problems) == (given(*row), ())
    env.step(allowed)
    taken = env._env.unwrapped.taken[-1]
    assert taken["arm"].tolist() == [0.5, -0.25]
    assert (taken["gripper"], taken["lamps"].tolist()) == (1, [1, 0])
    assert (taken["walk"][0].tolist(), taken["walk"][1]) == ([0, 2], 1)
    assert env.acted == dict(zip(NAMES, row, strict=True))


def test_what_is_beyond_a_parts_limits_is_named() -> None:
    gate = gate_of(GymEnv(HAND, render=False))
    allowed, problems = gate.check(given(1.02, *[0.0] * 7), NOWHERE)
    assert allowed == given(1.0, *[0.0] * 7)
    assert problems == ("arm.0: 1.02 is outside [-1, 1]",)
    allowed, problems = gate.check(given(*[0.0] * 3, -0.3, *[0.0] * 3, 1.5), NOWHERE)
    assert allowed is None
    assert [problem.partition(":")[0] for problem in problems] == ["lamps.0", "walk.1"]


def test_a_file_may_name_the_numbers_of_all_parts() -> None:
    names = tuple("abcdefgh")
    env = GymEnv(HAND, GymConfig(actions=names), render=False)
    assert gate_of(env).check(given(*[0.0] * 8, names=names), NOWHERE)[1] == ()
    assert gate_of(env).check(given(*[0.0] * 8, names=NAMES), NOWHERE)[0] is None
    with pytest.raises(ConfigError, match=r"2 names in `actions` for .* of 8"):
        GymEnv(HAND, GymConfig(actions=("a", "b")), render=False)


def test_a_script_gives_what_the_environment_itself_takes() -> None:
    env = GymEnv(HAND, render=False)
    taken = {"arm": [0.5, 0.5], "gripper": -1, "lamps": [0, 1], "walk": ([1, 3], 0)}
    assert env.action_of(taken).rows[0] == pytest.approx((0.5, 0.5, -2 / 3, 0, 1, 0.5, 0.75, -0.5))
    for wrong in ({}, {**taken, "gripper": 2}, {**taken, "walk": [[1, 3]]}, [0.0] * 8, 1):
        with pytest.raises(
            ModelError, match=r"expected an action of tests.runner.gym_worlds:test/Hand-v0, got "
        ):
            env.action_of(wrong)


def test_the_action_that_waits_may_have_parts() -> None:
    hold = {"arm": [0.25, 0.0], "gripper": 1, "lamps": [1, 1], "walk": [[0, 0], 0]}
    env = GymEnv(HAND, GymConfig.model_validate({"hold": hold}), render=False)
    env.reset(0)
    assert env.step(None).moved
    assert env._env.unwrapped.taken[-1]["arm"].tolist() == [0.25, 0.0]
    with pytest.raises(ConfigError, match="`hold` is not an action"):
        GymEnv(HAND, GymConfig.model_validate({"hold": {**hold, "gripper": 5}}), render=False)


@pytest.mark.parametrize(
    "space",
    [
        spaces.MultiBinary(3),
        spaces.MultiDiscrete([[2, 3], [4, 5]]),
        spaces.Tuple(
            (spaces.Discrete(2), spaces.Dict(a=spaces.Box(-1, 1, ()), b=spaces.MultiBinary([2, 2])))
        ),
        spaces.Box(0, 1, (2,), np.bool_),
    ],
    ids=str,
)
def test_random_actions_of_every_kind_are_the_spaces_own_and_follow_from_the_seed(
    space: Any,
) -> None:
    def play() -> list[Any]:
        env = plain(space)
        runner = sim_runner(
            lambda: env, rate_hz=0, episodes=2, max_steps=5, policy=policy_of("random").play
        )
        runner.activate()
        runner.run()
        assert (runner.robot.policy_error, list(runner.slot.violations)) == (None, [])
        taken: list[Any] = env._env.unwrapped.taken
        assert len(taken) == 10
        assert all(map(space.contains, taken))
        return taken

    assert str(play()) == str(play())


@pytest.mark.parametrize(
    ("space", "said"),
    [
        (spaces.Text(3), "it is Text.*: a text is not a number"),
        (
            spaces.Dict(say=spaces.Text(3), go=spaces.Discrete(2)),
            "say is Text.*: a text is not a number",
        ),
        (spaces.Tuple((spaces.Sequence(spaces.Discrete(2)),)), "0 is Sequence.*longer one time"),
        (
            spaces.OneOf((spaces.Discrete(2), spaces.Discrete(3))),
            "it is OneOf.*which of its alternatives",
        ),
        (spaces.Graph(spaces.Box(0, 1, (1,)), None), "it is Graph.*more nodes"),
    ],
)
def test_actions_that_are_no_row_of_numbers_are_refused_with_the_reason(
    space: Any, said: str
) -> None:
    with pytest.raises(ConfigError, match=f"no row of numbers: {said}") as error:
        plain(space)
    assert "Dict and Tuple" in (error.value.hint or "")


def test_a_discretes_copy_that_is_no_choice_does_not_pass() -> None:
    """Regression: copies are not validated, and only rows were checked again."""
    env = plain(spaces.Discrete(3))
    env.reset(0)
    for number in (float("nan"), -7.0, 7.0):
        copy = env.action_of(1).model_copy(update={"composite_mode": (number,)})
        assert gate_of(env).check(copy, NOWHERE)[0] is None


# -- observations
def test_joints_may_be_spread_over_the_parts_of_an_observation() -> None:
    observed = spaces.Dict(
        arm=spaces.Box(-9, 9, (2,), np.float64),
        claw=spaces.Tuple((spaces.Discrete(5), spaces.MultiBinary(2))),
    )
    seen = {"arm": np.array([0.5, -0.5]), "claw": (4, np.array([0, 1], np.int8))}
    names = ["arm.0", "arm.1", "claw.0", "claw.1.0", "claw.1.1"]
    env = plain(spaces.Discrete(2), observed, seen, joints=names)
    env.reset(0)
    state = env.observe(5, None).joint_state
    assert (list(state.name), state.position) == (names, (0.5, -0.5, 4.0, 0.0, 1.0))
    env = plain(spaces.Discrete(2), observed, seen, state="claw.1", joints=["left", "right"])
    env.reset(0)
    assert env.observe(5, None).joint_state.position == (0.0, 1.0)


@pytest.mark.parametrize(
    ("state", "said"),
    [
        ("", "views.0 is a picture"),
        ("order", "order is Text.*a text is not a number"),
        ("views", "views.0 is a picture"),
        ("arms", "there is no such part"),
        ("ar", "there is no such part"),
    ],
)
def test_joints_that_are_nowhere_are_refused_with_the_reason(state: str, said: str) -> None:
    with pytest.raises(ConfigError, match=f"has no numbers at '{state}': .*({said})"):
        GymEnv(HAND, GymConfig(state=state, joints={"a": 0}), render=False)


def test_a_part_that_is_shorter_than_promised_does_not_shift_the_others() -> None:
    observed = spaces.Tuple((spaces.Box(-1, 1, (2,)), spaces.Box(-1, 1, (2,))))
    env = plain(spaces.Discrete(2), observed, (np.zeros(1), np.ones(2)), joints=["a", "b"])
    with pytest.raises(EnvironmentFailed, match="0 has 1 numbers, 2 were promised"):
        env.reset(0)


def test_what_is_left_out_of_a_recording_is_said_once(caplog: pytest.LogCaptureFixture) -> None:
    observed = spaces.Dict(
        a=spaces.Box(-1, 1, (2,)),
        depth=spaces.Box(0, 9, (64, 65)),
        heat=spaces.Box(0, 255, (4, 4), np.uint8),
        order=spaces.Text(3),
        top=PICTURE,
    )
    env = plain(spaces.Discrete(2), observed)
    env.reset(0)
    assert [list(env.shown()) for _ in range(2)] == [["a.0", "a.1"]] * 2
    (said,) = caplog.messages
    assert said.endswith("not recorded of its observation: depth (Box), heat (Box), order (Text)")


def test_pictures_in_a_tuple_are_cameras() -> None:
    env = plain(spaces.Discrete(2), spaces.Tuple((PICTURE, spaces.Dict(eye=PICTURE))))
    env.reset(0)
    assert env.cameras == ("0", "eye")
    assert (env.render("eye") == env.observation[1]["eye"]).all()
    env = plain(spaces.Discrete(2), spaces.Tuple((PICTURE, PICTURE)), cameras={"left": "1"})
    env.reset(0)
    assert env.cameras == ("left",)
    assert (env.render("left") == env.observation[1]).all()


def test_two_pictures_of_the_same_last_name_are_two_cameras() -> None:
    """Regression: the last key was the camera's name, so one of `left.rgb` and `right.rgb` was
    lost."""
    eyes = spaces.Dict(left=spaces.Dict(rgb=PICTURE), right=spaces.Dict(rgb=PICTURE), top=PICTURE)
    env = plain(spaces.Discrete(2), eyes)
    env.reset(0)
    assert env.cameras == ("left.rgb", "right.rgb", "top")
    assert (env.render("left.rgb") == env.observation["left"]["rgb"]).all()


def test_an_observed_picture_that_is_called_render_is_that_picture() -> None:
    """Regression: a key named `render` was taken for the environment's own rendering."""
    env = plain(spaces.Discrete(2), spaces.Dict(render=PICTURE))
    env.reset(0)
    assert (env.render("render") == env.observation["render"]).all()


def test_two_parts_that_cannot_be_told_apart_are_refused() -> None:
    twice = spaces.Dict({"a.b": PICTURE, "a": spaces.Dict(b=PICTURE)})
    with pytest.raises(ConfigError, match=r"two parts .* are called a\.b"):
        plain(spaces.Discrete(2), twice)
    twice = spaces.Dict({"a": spaces.Box(0, 1, (2,)), "a.0": spaces.Discrete(2)})
    with pytest.raises(ConfigError, match=r"two numbers .* are called a\.0"):
        plain(spaces.Discrete(2), twice)


# -- the loop and the benchmark on them
def seeker() -> Policy:
    """Reads how far the arm is off, as the environment tells it, and closes the gripper with the
    second step.
    """

    def make(env: Any, seed: int) -> Any:
        aim: list[float] = []

        def act(world: WorldState) -> Any:
            known = bool(aim)
            aim[:] = aim or env.observation["arm"].tolist()
            return {"arm": aim, "gripper": int(known), "lamps": [0, 1], "walk": ([0, 0], 1)}

        return act

    return Policy("seeker", make)


def test_a_goal_plays_an_episode_of_parts_to_its_success() -> None:
    env = GymEnv(HAND, render=False)
    runner = sim_runner(lambda: env, rate_hz=0, seed=3)
    ended: list[SkillEnded] = []

    class Skill:
        manifest: Any = None
        key = SkillKey("test/skill")
        cameras = ("views.0",)
        fraction = 0.0

        def wants_frames(self) -> bool:
            return True

        def step(self, world: WorldState) -> Any:
            frame = (world.image_frames or {})["views.0"]
            assert (frame.width, frame.height) == (16, 16)
            x, y = env._env.unwrapped.target
            return Act(given(x, y, 1.0, 0, 0, 0, 0, 0))

    runner.activate()
    runner.tick()
    runner.begin_skill(Skill(), Goal("g", "r"), ended.append)
    tick = runner.tick()
    assert (tick.terminated, tick.success, tick.step_idx) == (True, True, 0)
    assert ended[0].error is None


def test_a_benchmark_of_such_a_world_is_the_same_for_the_same_seeds(
    run_async: Callable[[Any], Any],
) -> None:
    def play(policy: Policy) -> Cell:
        runner = sim_runner(lambda: GymEnv(HAND, render=False), rate_hz=0, ends_with_skill=True)
        cell: Cell = run_async(
            Benchmark(runner, world=HAND).run(PolicyContestant(policy), range(5, 15))
        )
        return cell

    cell = play(seeker())
    assert (cell.judged, cell.successes, cell.errors) == (10, 10, 0)
    assert {played.steps for played in cell.episodes} == {2}
    first, again = (
        [(p.seed, p.success, p.steps, p.total_reward) for p in play(policy_of("random")).episodes]
        for _ in range(2)
    )
    assert first == again
    assert [seed for seed, *_ in first] == list(range(5, 15))
    assert not all(success for _, success, *_ in first)
