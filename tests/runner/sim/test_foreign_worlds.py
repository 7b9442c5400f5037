"""Gymnasium environments that do not keep their word: what they give is refused as what it is, and
never becomes somebody's verdict.
"""

import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.heavy

np = pytest.importorskip("numpy")
gymnasium = pytest.importorskip("gymnasium")

from vram_arbiter.runner.sim.benchmark import Benchmark, Cell, PolicyContestant  # noqa: E402
from vram_arbiter.runner.sim.gym_config import GymConfig  # noqa: E402
from vram_arbiter.runner.sim.gym_env import GymEnv  # noqa: E402
from vram_arbiter.runner.sim.policies import Policy, PolicyPlayer  # noqa: E402
from vram_arbiter.runner.sim.robot import sim_runner  # noqa: E402
from vram_arbiter.schemas.errors import ConfigError, EnvironmentFailed  # noqa: E402

Run = Callable[[Any], Any]
ROOT = Path(__file__).parents[3]
ID = "test/Odd-v0"
SPACE = gymnasium.spaces.Box(-1.0, 1.0, (1,), np.float32)


class Odd(gymnasium.Env[Any, Any]):
    """`steps` maps the count of a step, over all episodes, to what it returns instead of the
    ordinary; an error is raised.
    """

    def __init__(self, steps: Any = None) -> None:
        self.odd: dict[int, Any] = steps or {}
        self.action_space = SPACE
        self.observation_space = gymnasium.spaces.Dict(
            {
                "v": gymnasium.spaces.Box(-1, 1, (2,), np.float64),
                "eye": gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8),
            }
        )
        self.count = 0
        self.resets: list[int | None] = []

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.resets.append(seed)
        return SEEN, {}

    def step(self, action: Any) -> Any:
        self.count += 1
        given = self.odd.get(self.count, (SEEN, 0.0, False, False, {}))
        if isinstance(given, Exception):
            raise given
        return given


SEEN = {"v": np.zeros(2), "eye": np.zeros((8, 8, 3), np.uint8)}
if ID not in gymnasium.registry:
    gymnasium.register(ID, Odd)
JOINTS = {"state": "v", "joints": ["a", "b"], "hold": [0.0]}


def gym_world(steps: dict[int, Any], **config: Any) -> GymEnv:
    return GymEnv(
        ID, GymConfig.model_validate({"kwargs": {"steps": steps}, **config}), render=False
    )


class Looks(PolicyPlayer):
    """A policy that wants the camera's pictures."""

    cameras = ("eye",)

    def wants_frames(self) -> bool:
        return True


class Plays(PolicyContestant):
    """So many actions an episode, then done; looks through the camera."""

    def __init__(self, *actions: int) -> None:
        self.left = list(actions)
        super().__init__(Policy("test", lambda env, seed: lambda seen: None))

    def player(self, env: Any, seed: int) -> Any:
        left = self.left.pop(0)

        def act(seen: Any) -> Any:
            nonlocal left
            left -= 1
            return None if left < 0 else [0.0]

        return Looks("test", env, act)


def play_world(run_async: Run, env: GymEnv, *actions: int, max_steps: int = 50) -> Cell:
    runner = sim_runner(lambda: env, rate_hz=0, ends_with_skill=True, max_steps=max_steps)
    bench = Benchmark(runner, world="odd", episode_s=60)
    cell: Cell = run_async(bench.run(Plays(*actions), range(len(actions))))
    return cell


GOOD = (SEEN, 0.0, True, False, {"success": True})


def test_an_episode_whose_last_step_fails_is_not_the_one_before(run_async: Run) -> None:
    """The policy is done in the tick in which the world raises: there is no episode, and the last
    one must not count again.
    """
    env = gym_world({1: GOOD, 3: ZeroDivisionError("the physics blew up")}, hold=[0.0])
    cell = play_world(run_async, env, 1, 1, 1)
    assert [(e.success, e.error) for e in cell.episodes][:2] == [
        (True, ""),
        (None, "environment_failed"),
    ]
    assert (cell.episodes[2].success, cell.episodes[2].error) == (
        False,
        "",
    )  # the world said nothing of it
    assert (cell.judged, cell.successes, cell.errors) == (2, 1, 1)


def test_a_world_that_speaks_only_of_successes_does_not_make_them_all(run_async: Run) -> None:
    """Regression: episodes without a word were left out, which gave 100 % success for one in
    ten.
    """
    env = gym_world({2: GOOD})
    cell = play_world(run_async, env, 1, 1, 1)
    assert [e.success for e in cell.episodes] == [False, True, False]
    assert (cell.judged, cell.success_rate) == (3, 1 / 3)


@pytest.mark.parametrize(
    "odd",
    [
        (SEEN, None, False, False, {}),
        (SEEN, 0.0, np.array([True, False]), False, {}),
        (SEEN, 0.0, False, False, {"success": float("nan")}),
        (SEEN, 0.0, False, False, {"success": np.array([True, False])}),
        (SEEN, 0.0, False, False, {"success": "False"}),
        (SEEN, 0.0, False, False, {"success": 0.3}),
        ({"v": np.zeros(1), "eye": SEEN["eye"]}, 0.0, False, False, {}),
        ({"eye": SEEN["eye"]}, 0.0, False, False, {}),
        ({"v": np.zeros(2)}, 0.0, False, False, {}),
        ({"v": np.zeros(2), "eye": np.zeros((8, 9, 3), np.uint8)}, 0.0, False, False, {}),
        ({"v": np.zeros(2), "eye": np.zeros((8, 8, 3))}, 0.0, False, False, {}),
    ],
    ids=[
        "reward none",
        "two ends",
        "success nan",
        "two successes",
        "success text",
        "success part",
        "vector short",
        "vector gone",
        "picture gone",
        "picture of another size",
        "picture of floats",
    ],
)
def test_what_was_not_promised_is_the_worlds_failure_and_the_next_episode_is_played(
    run_async: Run, odd: Any
) -> None:
    """Regression: `"False"` counted as success, and a short vector ended the whole benchmark with a
    traceback."""
    cell = play_world(run_async, gym_world({2: odd, 6: GOOD}, **JOINTS), 3, 3, 3)
    assert (cell.episodes[0].success, cell.episodes[0].error) == (None, "environment_failed")
    assert any(e.success for e in cell.episodes[1:])
    assert cell.successes == 1
    assert not any(e.error for e in cell.episodes[1:])


@pytest.mark.parametrize(
    "said", [True, np.True_, 1, 1.0, np.float32(1), np.array(1), np.array([True])]
)
def test_every_plain_yes_is_one(said: Any) -> None:
    env = gym_world({1: (SEEN, 0.0, True, False, {"success": said})})
    env.reset(0)
    assert env.step(env.action_of([0.0])).success is True


def test_a_number_that_is_none_does_not_pass_however_it_was_built() -> None:
    """Regression: copies of an action are not validated, and every comparison with NaN is false."""
    env = gym_world({})
    env.reset(0)
    broken = env.action_of([0.0]).model_copy(update={"joint_targets": ((float("nan"),),)})
    gate = env.gate(PolicyPlayer("test", env, lambda seen: None))
    allowed, problems = gate.check(broken, env.observe(0, None))
    assert allowed is None
    assert problems


def test_a_run_in_which_only_a_success_was_told_is_not_all_successes() -> None:
    """Regression: episodes without a word were left out, which gave 100 % success for one in
    ten.
    """
    env = gym_world({2: GOOD}, hold=[0.0])
    policy = Policy("test", lambda env, seed: lambda seen: [0.0])
    runner = sim_runner(lambda: env, rate_hz=0, episodes=3, max_steps=1, policy=policy.play)
    runner.activate()
    assert runner.run().success is False


def test_a_policy_that_is_done_as_its_world_fails_does_not_play_for_ever() -> None:
    """Regression: both in one tick left no listener for the failure, and the episode was repeated
    for ever."""
    env = gym_world({n: ZeroDivisionError("again") for n in range(1, 9)}, hold=[0.0])
    policy = Policy("test", lambda env, seed: lambda seen: None)
    runner = sim_runner(lambda: env, rate_hz=0, episodes=1, policy=policy.play)
    runner.activate()
    runner.run(max_ticks=30)
    assert isinstance(runner.robot.policy_error, EnvironmentFailed)
    assert env._env.unwrapped.resets == [0]
    assert runner.robot.episodes == []


def test_pictures_that_change_their_size_do_not_garble_a_video(tmp_path: Path) -> None:
    """Regression: ffmpeg receives bytes, so a picture of another size garbled the rest of the
    video."""
    from vram_arbiter.runner.recording.video import VideoRecorder

    recorder = VideoRecorder(tmp_path / "v.mp4", fps=30, wait=True)
    for size in (64, 64, 96, 64):
        recorder.submit(np.zeros((size, 64, 3), np.uint8), ())
    recorder.close()
    assert "64 × 96" in recorder.error
    assert recorder.written == 2


def test_a_video_that_the_disk_had_no_room_for_is_none(tmp_path: Path) -> None:
    """The end of the file is written when it is closed: until then ffmpeg takes every picture."""
    script = """
import resource, signal, sys
from pathlib import Path
import numpy as np
from vram_arbiter.runner.recording.video import VideoRecorder
signal.signal(signal.SIGXFSZ, signal.SIG_IGN)
for room in (20_000, 1 << 20):
    resource.setrlimit(resource.RLIMIT_FSIZE, (room, resource.RLIM_INFINITY))
    recorder = VideoRecorder(Path(sys.argv[1]) / f"{room}.mp4", fps=30, wait=True)
    noise = np.random.default_rng(0)
    for _ in range(12):
        recorder.submit(noise.integers(0, 255, (96, 96, 3), dtype=np.uint8), ())
    recorder.close()
    print(recorder.written, bool(recorder.error))
"""
    ran = subprocess.run(
        [sys.executable, "-c", script, str(tmp_path)],
        capture_output=True,
        text=True,
        check=True,
        cwd=ROOT,
    )
    assert ran.stdout.split() == ["12", "True", "12", "False"]


class Sketch(gymnasium.Env[Any, Any]):
    """Draws over its last picture, as simulators do; renders what it is told to."""

    metadata = {"render_modes": ["rgb_array"]}  # noqa: RUF012 — gymnasium's own way

    def __init__(self, render_mode: str | None = None, film: Any = None) -> None:
        self.render_mode = render_mode
        self.film = np.zeros((8, 8, 3), np.uint8) if film is None else film
        self.eye = np.zeros((8, 8, 3), np.uint8)
        self.action_space = gymnasium.spaces.Discrete(2)
        self.observation_space = gymnasium.spaces.Dict(
            eye=gymnasium.spaces.Box(0, 255, (8, 8, 3), np.uint8)
        )

    def reset(self, *, seed: int | None = None, options: Any = None) -> tuple[Any, dict[str, Any]]:
        super().reset(seed=seed)
        self.eye[:] = 0
        return {"eye": self.eye}, {}

    def step(self, action: Any) -> Any:
        self.eye += 9
        self.film += 9
        return {"eye": self.eye}, 0.0, False, False, {}

    def render(self) -> Any:
        return self.film


if "test/Sketch-v0" not in gymnasium.registry:
    gymnasium.register("test/Sketch-v0", Sketch)


def test_a_picture_that_was_taken_does_not_change_any_more() -> None:
    """Regression: an environment that reuses its array changed pictures that were being encoded."""
    env = GymEnv("test/Sketch-v0")
    env.reset(0)
    taken = [env.render(camera) for camera in ("eye", "render")]
    env.step(env.action_of(1))
    assert [int(picture.max()) for picture in taken] == [0, 0]
    assert [int(env.render(camera).max()) for camera in ("eye", "render")] == [9, 9]


@pytest.mark.parametrize(
    "film", [np.full((8, 8, 3), 0.7), np.full((8, 8, 3), 300), np.zeros((8, 8), np.uint8)]
)
def test_what_is_rendered_in_other_numbers_is_not_made_a_picture(film: Any) -> None:
    """0.7 of white would be black, 300 would be dark."""
    env = GymEnv("test/Sketch-v0", GymConfig(kwargs={"film": film}))
    env.reset(0)
    assert env.cameras == ("eye",)
    with pytest.raises(EnvironmentFailed, match="renders no picture"):
        env.render("render")


class Silent(gymnasium.Env[Any, Any]):
    """Says nothing of what it takes or shows."""


class Broken(Sketch):
    """Its action space can do nothing."""

    def __init__(self, render_mode: str | None = None, works: str = "") -> None:
        super().__init__(render_mode)
        for name in {"seed", "sample"} - {works}:
            setattr(self.action_space, name, self._raise)

    def _raise(self, *_: Any) -> Any:
        raise RuntimeError("no dice")


for name, kind in (("test/Silent-v0", Silent), ("test/Broken-v0", Broken)):
    if name not in gymnasium.registry:
        gymnasium.register(name, kind)


def test_an_environment_without_spaces_is_refused() -> None:
    """Regression: it ended the runner with a traceback."""
    with pytest.raises(ConfigError, match="test/Silent-v0 has no action_space"):
        GymEnv("test/Silent-v0")


def test_an_action_space_that_fails_is_the_environments_failure() -> None:
    """Regression: only errors of `make`, `reset` and `step` were taken for foreign code."""
    with pytest.raises(EnvironmentFailed, match=r"Broken-v0.reset: RuntimeError: no dice"):
        GymEnv("test/Broken-v0", render=False).reset(0)
    env = GymEnv("test/Broken-v0", GymConfig(kwargs={"works": "seed"}), render=False)
    env.reset(0)
    with pytest.raises(EnvironmentFailed, match=r"action_space.sample: RuntimeError: no dice"):
        env.sample()
