"""Any gymnasium environment as a world: what it says is handed on as it is, what it does not say is
missing, what it cannot do is refused.
"""

from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.heavy

gym_env = pytest.importorskip("vram_arbiter.runner.sim.gym_env")
np = pytest.importorskip("numpy")
pytest.importorskip("gymnasium")

from vram_arbiter.runner.protocols import Act, Goal, Hold, SkillEnded, SkillKey  # noqa: E402
from vram_arbiter.runner.sim.gym_config import GymConfig  # noqa: E402
from vram_arbiter.runner.sim.gym_env import GymEnv  # noqa: E402
from vram_arbiter.runner.sim.policies import policy_of  # noqa: E402
from vram_arbiter.runner.sim.robot import sim_runner  # noqa: E402
from vram_arbiter.schemas.control import ControlMode  # noqa: E402
from vram_arbiter.schemas.errors import ConfigError, EnvironmentFailed, ModelError  # noqa: E402
from vram_arbiter.schemas.world import Action, JointState, WorldState  # noqa: E402

POINT = "tests.runner.gym_worlds:test/Point-v0"
NAMED = GymConfig(state="agent_pos", joints={"a": 0, "b": 1}, actions=("a", "b"))
NOWHERE = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))


def targets(*row: float, names: tuple[str, ...] | None = None) -> Action:
    return Action(control_mode=ControlMode.JOINT_POSITION, joint_targets=(row,), joint_names=names)


class Policy:
    """Does what the function says; a skill of the tests."""

    manifest: Any = None
    key = SkillKey("test/skill")
    holds_gpu = False
    cameras: tuple[str, ...] = ()
    fraction = 0.0

    def __init__(self, act: Any) -> None:
        self.step = act

    def wants_frames(self) -> bool:
        return bool(self.cameras)


ANYBODY = Policy(None)


# -- observations
def test_joints_are_only_those_that_the_file_names() -> None:
    env = GymEnv(POINT)
    env.reset(3)
    assert env.observe(5, None).joint_state.name == ()
    env = GymEnv(
        POINT,
        GymConfig(state="agent_pos", joints={"b": 1, "mark": 3}, velocities={"b": 0, "mark": 2}),
    )
    env.reset(3)
    state = env.observe(5, None).joint_state
    vector = env.observation["agent_pos"]
    assert (state.name, state.position) == (("b", "mark"), (vector[1], vector[3]))
    assert state.velocity == (vector[0], vector[2])
    assert state.stamp_ns == 5


def test_pictures_of_the_observation_are_cameras() -> None:
    env = GymEnv(POINT, render=False)
    env.reset(3)
    assert env.cameras == ("top",)
    assert (env.render("top") == env.observation["pixels"]["top"]).all()
    with pytest.raises(KeyError):
        env.render("front")
    renamed = GymEnv(POINT, GymConfig(cameras={"front": "pixels.top", "own": "render"}))
    renamed.reset(3)
    assert renamed.cameras == ("front", "own")
    assert renamed.render("own").shape == (24, 33, 3)


def test_the_same_seed_is_the_same_episode() -> None:
    def play() -> list[Any]:
        env = GymEnv(POINT)
        env.reset(11)
        actions = [env.sample() for _ in range(3)]
        return [*actions, *(env.step(action).reward for action in actions)]

    assert play() == play()


def test_random_actions_are_not_the_worlds_own_random_numbers() -> None:
    env = GymEnv(POINT, render=False)
    for seed in range(20):
        env.reset(seed)
        assert not env.step(env.sample()).success


# -- actions
def test_every_number_of_a_discrete_goes_there_and_back() -> None:
    env = GymEnv("CartPole-v1", render=False)
    for number in (0, 1):
        allowed, problems = env.gate(ANYBODY).check(env.action_of(number), NOWHERE)
        assert (allowed, problems) == (env.action_of(number), ())
        assert env._row.element((env.action_of(number).rows[0],)) == number
    for wrong in (2, -1, 0.5, [0, 1], "left", float("nan")):
        with pytest.raises(ModelError):
            env.action_of(wrong)
    assert env.gate(ANYBODY).check(targets(0.0), NOWHERE)[0] is None


def test_named_columns_are_sorted_into_the_environments_order() -> None:
    env = GymEnv(POINT, NAMED)
    env.reset(0)
    allowed, problems = env.gate(ANYBODY).check(targets(0.5, -0.25, names=("b", "a")), NOWHERE)
    assert (allowed, problems) == (targets(-0.25, 0.5), ())
    env.step(allowed)
    assert env.observation["agent_pos"][:2] == pytest.approx([-0.25, 0.5])


@pytest.mark.parametrize(
    ("action", "said"),
    [
        (targets(0.1), "1 numbers for an action of 2"),
        (targets(0.1, 0.2, names=("a", "x")), "named a, x"),
        (targets(1.2, 0.0), "outside"),
        (
            Action(control_mode=ControlMode.BODY_TWIST, body_twist=((0.0,) * 6,)),
            "takes joint_position",
        ),
        (
            Action(
                control_mode=ControlMode.JOINT_POSITION, joint_targets=((0.0, 0.0),) * 2, horizon=2
            ),
            "one step",
        ),
    ],
)
def test_what_does_not_fit_the_space_is_withheld(action: Action, said: str) -> None:
    allowed, problems = GymEnv(POINT, NAMED).gate(ANYBODY).check(action, NOWHERE)
    assert allowed is None
    assert said in problems[0]


def test_an_aim_at_the_stop_is_clamped_and_said() -> None:
    allowed, problems = GymEnv(POINT).gate(ANYBODY).check(targets(1.05, 0.0), NOWHERE)
    assert allowed == targets(1.0, 0.0)
    assert len(problems) == 1


# -- the loop on it
def test_one_step_per_tick_and_the_world_waits_without_an_action() -> None:
    env = GymEnv(POINT, NAMED)
    runner = sim_runner(lambda: env, rate_hz=0, seed=4)
    ended: list[SkillEnded] = []
    script: list[Any] = [Hold("thinking"), Act(targets(0.95, 0.95)), Hold("thinking")]

    def act(world: WorldState) -> Any:
        return (
            script.pop(0)
            if script
            else Act(targets(*env.observation["agent_pos"][2:], names=("a", "b")))
        )

    runner.activate()
    assert runner.tick().step_idx is None
    assert runner.camera_names() == ("top", "render")
    assert runner.tick().step_idx is None  # nobody has it yet: it stands still
    runner.begin_skill(Policy(act), Goal("g", "r"), ended.append)
    ticks = [runner.tick() for _ in range(4)]
    assert [tick.step_idx for tick in ticks] == [None, 0, None, 1]
    assert [tick.action_applied for tick in ticks] == [False, True, False, True]
    assert (ticks[1].reward or 0) < -0.04
    assert (ticks[3].terminated, ticks[3].success) == (True, True)
    assert ended[0].error is None
    assert ended[0].data["total_reward"] == pytest.approx(sum(tick.reward or 0 for tick in ticks))
    runner.tick()
    assert env._env.unwrapped.resets == [4, 5]
    runner.deactivate()
    assert env._env.unwrapped.resets == [4, 5]


def test_a_skill_sees_the_observations_picture() -> None:
    env = GymEnv(POINT, NAMED, render=False)
    runner = sim_runner(lambda: env, rate_hz=0)
    seen: list[WorldState] = []

    def act(world: WorldState) -> Any:
        seen.append(world)
        return Act(targets(0.5, 0.5))

    skill = Policy(act)
    skill.cameras = ("top",)
    runner.activate()
    runner.tick()
    runner.begin_skill(skill, Goal("g", "r"), lambda _: None)
    runner.tick()
    frame = (seen[0].image_frames or {})["top"]
    assert (frame.width, frame.height) == (33, 24)
    assert seen[0].joint_state.name == ("a", "b")


def test_its_own_time_limit_truncates_an_episode() -> None:
    runner = sim_runner(lambda: GymEnv(POINT, render=False), rate_hz=0, episodes=2)
    runner.activate()
    runner.tick()
    ended: list[SkillEnded] = []
    runner.begin_skill(Policy(lambda world: Act(targets(0.99, 0.99))), Goal("g", "r"), ended.append)
    while not ended:
        runner.tick()
    assert [(e.steps, e.success, e.truncated) for e in runner.robot.episodes] == [(20, False, True)]
    assert ended[0].error is not None
    assert ended[0].error.code == "limit_exceeded"


def test_foreign_code_that_raises_is_a_typed_error() -> None:
    env = GymEnv(POINT, GymConfig(kwargs={"fails_at": 1}))
    env.reset(0)
    env.step(targets(0.0, 0.0))
    with pytest.raises(EnvironmentFailed, match="ZeroDivisionError: the physics blew up"):
        env.step(targets(0.0, 0.0))


def test_success_by_the_sum_of_rewards_and_by_nobody() -> None:
    env = GymEnv("CartPole-v1", GymConfig(success="return:2"), render=False)
    env.reset(0)
    assert [env.step(env.action_of(n)).success for n in (0, 1)] == [False, True]
    silent = GymEnv(POINT, GymConfig(kwargs={"told": False}), render=False)
    silent.reset(0)
    assert silent.step(targets(0.0, 0.0)).success is None


def test_a_configured_action_waits() -> None:
    env = GymEnv(POINT, GymConfig(hold=(0.25, 0.0)), render=False)
    env.reset(0)
    assert env.step(None).moved
    assert env.observation["agent_pos"][0] == 0.25


# -- a real simulator
def test_a_mujoco_environment_of_gymnasium_is_driven_and_seen() -> None:
    config = GymConfig(
        control_mode=ControlMode.JOINT_TORQUE,
        joints={"cart": 0, "pole": 1},
        velocities={"cart": 2, "pole": 3},
    )
    env = GymEnv("InvertedPendulum-v5", config)
    runner = sim_runner(lambda: env, rate_hz=0, episodes=1)
    runner.activate()
    runner.tick()
    assert runner.camera_names() == ("render",)
    runner.begin_skill(
        Policy(lambda world: Act(env.action_of([3.0]))), Goal("g", "r"), lambda _: None
    )
    result = runner.run(max_ticks=200)
    assert runner.world is not None
    assert runner.world.joint_state.name == ("cart", "pole")
    assert runner.robot.episodes[0].steps == result.n_ticks < 100
    assert runner.snapshot("render", 0.5).rgb.any()
    runner.deactivate()


@pytest.mark.parametrize(
    "env_id", ["Acrobot-v1", "Pendulum-v1", "Blackjack-v1", "FrozenLake-v1", "Taxi-v4", "Pusher-v5"]
)
def test_gymnasiums_own_environments_of_all_kinds_can_be_played(env_id: str) -> None:
    runner = sim_runner(
        lambda: GymEnv(env_id, render=False),
        rate_hz=0,
        episodes=2,
        max_steps=10,
        policy=policy_of("random").play,
    )
    runner.activate()
    result = runner.run()
    runner.deactivate()
    assert runner.robot.policy_error is None
    assert list(runner.slot.violations) == []
    assert result.n_ticks == 2 + sum(episode.steps for episode in runner.robot.episodes)
    assert all(episode.total_reward is not None for episode in runner.robot.episodes)


# -- refusals
@pytest.mark.parametrize(
    ("env_id", "config", "said"),
    [
        ("NoSuch-v0", {}, "cannot be made"),
        ("no_such_module:X-v0", {}, "no_such_module"),
        (POINT, {"kwargs": {"colour": "red"}}, "colour"),
        (POINT, {"state": "agent_pos", "joints": {"z": 4}}, "index 4"),
        (POINT, {"joints": {"z": 0}}, "no numbers at ''"),
        (POINT, {"cameras": {"front": "pixels.side"}}, "pixels.side"),
        (POINT, {"actions": ("a",)}, "1 names"),
        (POINT, {"hold": (5.0, 0.0)}, "`hold`"),
        (POINT, {"hold": 1}, "`hold`"),
        ("Blackjack-v1", {"hold": 7}, "`hold`"),
    ],
)
def test_what_does_not_fit_is_refused_at_once(
    env_id: str, config: dict[str, Any], said: str
) -> None:
    with pytest.raises(ConfigError, match=said):
        GymEnv(env_id, GymConfig(**config))


def test_mistakes_in_a_file_are_named_by_line(tmp_path: Path) -> None:
    file = tmp_path / "world.yaml"
    file.write_text("state: agent_pos\njoint: [a]\nsuccess: maybe\n", encoding="utf-8")
    with pytest.raises(ConfigError, match=r"world.yaml:2: joint: unknown key.*joints") as error:
        GymConfig.load(file)
    assert "world.yaml:3: success" in str(error.value)
    file.write_text("joints: [a, b]\nvelocities: {a: 2, b: 3}\n", encoding="utf-8")
    assert GymConfig.load(file).joints == {"a": 0, "b": 1}
    with pytest.raises(ConfigError, match="cannot be read"):
        GymConfig.load(tmp_path / "none.yaml")
