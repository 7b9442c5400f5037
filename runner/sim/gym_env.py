"""`GymEnv`: any gymnasium environment by its id, as an `Environment`.

Actions. A Box is one row of numbers in the environment's own units, in its order, in the field of the configured `control_mode`; with
`actions` in its file an action may name its columns, in any order. A Discrete of n is `composite_mode`: [-1, 1] cut into n equal parts.
Other spaces are refused. What is out of a Box by at most 5 % of its range is clamped and said, more is withheld.

Observations. Pictures (uint8, height × width × 3) become cameras, the file's `joints` the joint state; everything else only scripted policies see.
The environment's code is foreign: whatever it raises becomes EnvironmentFailed.
"""

from __future__ import annotations

import logging
import math
import os
import random
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import Any

from runner.protocols import Stepped
from runner.sim.environment import EnvStep
from runner.sim.gym_config import RENDER, SUCCESS_KEYS, GymConfig
from schemas.control import ControlMode
from schemas.errors import ConfigError, EnvironmentFailed, ModelError
from schemas.world import PAYLOAD_OF_MODE, Action, JointState, SensorFrame, WorldState

log = logging.getLogger(__name__)

CLAMP_SHARE = 0.05  # of a Box's range: an aim at the stop; beyond it a mistake


@dataclass(frozen=True, slots=True)
class SpaceGate:
    """The limits of an action space, as a gate. Infinite limits hold nothing back; `low` of a Discrete is empty."""

    mode: ControlMode
    low: tuple[float, ...]
    high: tuple[float, ...]
    names: tuple[str, ...]

    def check(self, action: Action, world: WorldState) -> tuple[Action | None, tuple[str, ...]]:
        """The action to apply, clamped where the excess is small, or None; and what was wrong with it."""
        if action.control_mode is not self.mode:
            return None, (f"this environment takes {self.mode}, not {action.control_mode}",)
        if action.horizon != 1:
            return None, (f"one step at a time, not {action.horizon}",)
        if self.mode is ControlMode.COMPOSITE_MODE:
            return action, ()
        row = self.in_order(action)
        if isinstance(row, str):
            return None, (row,)
        problems, withheld, values = [], False, []
        if not all(map(math.isfinite, row)):  # copies of an action are not validated
            return None, (f"an action with numbers that are not finite: {row}",)
        for index, (value, low, high) in enumerate(zip(row, self.low, self.high, strict=True)):
            excess = max(low - value, value - high, 0.0)
            if excess > 0:
                name = self.names[index] if self.names else f"action[{index}]"
                problems.append(f"{name}: {value:.4g} is outside [{low:.4g}, {high:.4g}]")
                withheld |= excess > CLAMP_SHARE * (high - low)
            values.append(min(max(value, low), high))
        if withheld:
            return None, tuple(problems)
        update = {PAYLOAD_OF_MODE[self.mode]: (tuple(values),), "joint_names": None}
        return action.model_copy(update=update), tuple(problems)

    def in_order(self, action: Action) -> tuple[float, ...] | str:
        """The row in the environment's order, or why there is none."""
        row: tuple[float, ...] = action.rows[0]
        if len(row) != len(self.low):
            return f"{len(row)} numbers for an action of {len(self.low)}"
        if action.joint_names is None:
            return row
        if set(action.joint_names) != set(self.names):
            known = ", ".join(self.names) or "none: its file names no `actions`"
            return f"actions are named {', '.join(action.joint_names)}; the environment knows {known}"
        named = dict(zip(action.joint_names, row, strict=True))
        return tuple(named[name] for name in self.names)


class GymEnv:
    """`GymEnv("CartPole-v1", GymConfig())`. `render`: whether its `render()` is offered as a camera; None: where that works.

    Raises ConfigError for an id, a file or spaces that do not fit.
    """

    def __init__(self, env_id: str, config: GymConfig | None = None, *, render: bool | None = None) -> None:
        self.env_id = env_id
        self.config = config or GymConfig()
        self._render_wanted = render
        self._env = _make(env_id, self.config, pictures=render is not False)
        self._last = EnvStep()
        self._total_reward = 0.0
        self._steps = 0
        self._observation: Any = None
        try:
            self._gate = self._make_gate()
            self._hold = None if self.config.hold is None else self._held(self.config.hold)
            self._paths = self._cameras_of(self._env.observation_space)
            self._check_state(self._env.observation_space.sample())
        except BaseException:
            self.close()
            raise

    # -- what the spaces say -----------------------------------------------------------------------------------------------
    def _make_gate(self) -> SpaceGate:
        from gymnasium import spaces

        space = self._env.action_space
        if isinstance(space, spaces.Discrete):
            return SpaceGate(ControlMode.COMPOSITE_MODE, (), (), ())
        if not isinstance(space, spaces.Box):
            raise ConfigError(
                f"{self.env_id} takes actions of {space}",
                hint="Box and Discrete can be driven; wrap the environment to flatten others",
            )
        low, high = (tuple(map(float, bound.reshape(-1))) for bound in (space.low, space.high))
        names = self.config.actions
        if names and len(names) != len(low):
            raise ConfigError(f"{len(names)} names in `actions` for {self.env_id}'s actions of {len(low)}")
        return SpaceGate(self.config.control_mode, low, high, names)

    def _held(self, raw: int | tuple[float, ...]) -> Action:
        try:
            action = self.action_of(raw)
        except ModelError as error:
            raise ConfigError(f"`hold` is no action of {self.env_id}: {error.message}") from error
        if problems := self._gate.check(action, WORLDLESS)[1]:
            raise ConfigError(f"`hold` is no action of {self.env_id}: {problems[0]}")
        return action

    def _cameras_of(self, space: Any) -> dict[str, str]:
        found = dict(_pictures(space))
        for name, path in self.config.cameras.items():
            if path != RENDER and path not in found.values():
                known = ", ".join([*found.values(), RENDER])
                raise ConfigError(
                    f"camera {name}: {self.env_id} observes no picture at {path!r}",
                    hint=f"choose from {known}",
                )
        return dict(self.config.cameras) or found

    def _check_state(self, observation: Any) -> None:
        if not self.config.joints:
            return
        vector = self._vector(observation)
        for name, index in (*self.config.joints.items(), *self.config.velocities.items()):
            if index >= len(vector):
                raise ConfigError(
                    f"joint {name} has index {index} in the {len(vector)} numbers at {self.config.state!r}"
                )

    def _vector(self, observation: Any) -> Any:
        import numpy as np

        try:
            return np.asarray(_at(observation, self.config.state), dtype=float).reshape(-1)
        except (KeyError, TypeError, ValueError) as error:
            raise ConfigError(
                f"{self.env_id} has no numbers at {self.config.state!r}: {error}",
                hint="`state` is the path of the vector that holds the joints",
            ) from error

    # -- Environment -------------------------------------------------------------------------------------------------------
    def reset(self, seed: int) -> None:
        self._steps, self._total_reward = 0, 0.0
        # not the same seed: both draw from the same kind of generator, and random actions would be the world's own random numbers
        self._env.action_space.seed(random.Random(f"actions-{seed}").getrandbits(31))
        try:
            self._observation, info = self._env.reset(seed=seed)
        except Exception as error:
            raise self._failed("reset", error) from error
        self._check_observation()
        self._last = EnvStep(success=self._success(info))
        if self._render_wanted is None:
            self._render_wanted = self._can_render()
        if self._render_wanted and RENDER not in self._paths.values() and not self.config.cameras:
            self._paths[RENDER] = RENDER

    def _check_observation(self) -> None:
        """What is read of it must be what its space promised. Raises EnvironmentFailed."""
        try:
            self._check_state(self._observation)
        except ConfigError as error:
            raise EnvironmentFailed(error.message) from error
        space = self._env.observation_space
        for camera, path in self._paths.items():
            if path == RENDER:
                continue
            promised = _at(space, path)
            try:
                picture = _at(self._observation, path)
                as_promised = picture.dtype == promised.dtype and picture.shape == promised.shape
            except (KeyError, IndexError, TypeError, AttributeError):
                as_promised = False
            if not as_promised:
                raise EnvironmentFailed(
                    f"{self.env_id} observed no picture for {camera} as {promised} promises"
                )

    def observe(self, stamp_ns: int, frames: Mapping[str, SensorFrame] | None) -> WorldState:
        joints, velocities = self.config.joints, self.config.velocities
        vector = self._vector(self._observation) if joints else ()
        return WorldState(
            stamp_ns=stamp_ns,
            joint_state=JointState(
                name=tuple(joints),
                position=tuple(float(vector[index]) for index in joints.values()),
                velocity=tuple(float(vector[velocities[name]]) for name in joints) if velocities else (),
                stamp_ns=stamp_ns,
            ),
            image_frames=dict(frames) if frames is not None else None,
        )

    def step(self, action: Action | None) -> EnvStep:
        if action is None:
            action = self._hold
        if action is None:
            return EnvStep(success=self._last.success, moved=False)
        raw = self._raw(action)
        try:
            self._observation, given, terminated, truncated, info = self._env.step(raw)
            reward, terminated, truncated = float(given), bool(terminated), bool(truncated)
        except Exception as error:
            raise self._failed("step", error) from error
        self._check_observation()
        if not math.isfinite(reward):
            raise EnvironmentFailed(f"{self.env_id} gave the reward {reward}")
        self._steps += 1
        self._total_reward += reward
        self._last = EnvStep(reward, terminated, truncated, self._success(info))
        return self._last

    def gate(self, skill: Stepped) -> SpaceGate:
        """The action space is the only limit that is known here; what the skill's envelope asks for beyond it is said, once a goal."""
        envelope = None if skill.manifest is None else skill.manifest.envelope
        if envelope is not None and envelope.model_fields_set:
            asked = ", ".join(sorted(envelope.model_fields_set))
            log.warning("%s: not kept in %s: %s", skill.key, self.env_id, asked)
        return self._gate

    def action_of(self, raw: Any) -> Action:
        """A number of a Discrete, or the numbers of a Box in its order (any shape that has as many)."""
        import numpy as np

        space, mode = self._env.action_space, self._gate.mode
        try:
            values = [float(value) for value in np.asarray(raw, dtype=float).reshape(-1)]
        except (TypeError, ValueError) as error:
            raise ModelError(f"{raw!r} is no action of {self.env_id}: {error}") from error
        if not all(map(math.isfinite, values)):
            raise ModelError(f"an action with numbers that are not finite: {values}")
        if mode is ControlMode.COMPOSITE_MODE:
            chosen = round(values[0] - space.start) if len(values) == 1 else -1
            if not 0 <= chosen < space.n or values[0] != chosen + space.start:
                raise ModelError(f"{raw!r} is no action of {self.env_id}: {space}")
            return Action(control_mode=mode, composite_mode=(-1 + (2 * chosen + 1) / int(space.n),))
        if len(values) != len(self._gate.low):
            raise ModelError(f"{len(values)} numbers for {self.env_id}'s actions of {len(self._gate.low)}")
        return Action.model_validate({"control_mode": mode, PAYLOAD_OF_MODE[mode]: (tuple(values),)})

    def _raw(self, action: Action) -> Any:
        """What `gymnasium.Env.step` takes."""
        import numpy as np

        space = self._env.action_space
        if self._gate.mode is ControlMode.COMPOSITE_MODE:
            chosen = min(math.floor((action.rows[0] + 1) / 2 * int(space.n)), int(space.n) - 1)
            return int(space.start) + chosen
        row = self._gate.in_order(action)
        if isinstance(row, str):
            raise EnvironmentFailed(f"an action that the gate has not seen: {row}")
        values = np.asarray(row, dtype=float).reshape(space.shape)
        return (np.round(values) if np.issubdtype(space.dtype, np.integer) else values).astype(space.dtype)

    def sample(self) -> Action:
        return self.action_of(self._env.action_space.sample())

    @property
    def observation(self) -> Any:
        """The last observation, as gymnasium gives it."""
        return self._observation

    @property
    def targets(self) -> dict[str, float]:
        return {}  # its actions are its own affair

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self._paths)

    @property
    def clock_text(self) -> str:
        return f"step {self._steps}, return {self._total_reward:.2f}"

    # -- pictures ------------------------------------------------------------------------------------------------------
    def render(self, camera: str) -> Any:
        import numpy as np

        path = self._paths.get(camera, RENDER if camera == RENDER else None)
        if path is None:
            raise KeyError(camera)
        if path != RENDER:
            return np.ascontiguousarray(_at(self._observation, path))
        try:
            picture = self._env.render()
        except Exception as error:
            raise self._failed("render", error) from error
        if not isinstance(picture, np.ndarray) or picture.ndim != 3 or picture.shape[2] != 3:
            raise EnvironmentFailed(
                f"{self.env_id} renders no picture",
                hint="it needs the render mode rgb_array; leave videos out, or name a camera of its observation",
            )
        return np.ascontiguousarray(picture, dtype=np.uint8)

    def _can_render(self) -> bool:
        try:
            self.render(RENDER)
        except EnvironmentFailed as error:
            log.warning("no pictures of %s: %s", self.env_id, error)
            return False
        return True

    def camera_model(self, camera: str) -> None:
        return None

    def close(self) -> None:
        try:
            self._env.close()
        except Exception:
            log.exception("%s did not close cleanly", self.env_id)

    # -- judging -------------------------------------------------------------------------------------------------------
    def _success(self, info: Any) -> bool | None:
        kind, _, rest = self.config.success.partition(":")
        if kind == "return":
            return self._total_reward >= float(rest)
        for key in (rest,) if kind == "info" else SUCCESS_KEYS:
            value = info.get(key) if isinstance(info, Mapping) else None
            if value is not None:
                return self._yes_or_no(key, value)
        return None

    def _yes_or_no(self, key: str, value: Any) -> bool:
        """A truth value or a whole number. Half a success is none, nor is a text or a NaN. Raises EnvironmentFailed."""
        import numpy as np

        plain = np.asarray(value)
        if plain.size == 1 and plain.dtype.kind in "biuf" and float(plain.item()).is_integer():
            return bool(plain.item())
        raise EnvironmentFailed(
            f"{self.env_id} says {value!r} of {key}, which is neither yes nor no",
            hint="choose what a success is with `success`: info:KEY of a truth value, or return:NUMBER",
        )

    def _failed(self, what: str, error: Exception) -> EnvironmentFailed:
        return EnvironmentFailed(f"{self.env_id}.{what}: {type(error).__name__}: {error}")


WORLDLESS = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))


def _make(env_id: str, config: GymConfig, *, pictures: bool) -> Any:
    os.environ.setdefault("MUJOCO_GL", "egl")  # no display is needed, unless somebody says so
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    try:
        import gymnasium
        from gymnasium.envs.registration import load_env_creator
    except ImportError as error:
        raise ConfigError("gymnasium is not installed", hint="pip install 'vram-arbiter[runner]'") from error
    kwargs = dict(config.kwargs)
    try:
        if ":" in env_id:  # MODULE:ID registers by importing
            __import__(env_id.partition(":")[0])
        entry = gymnasium.spec(env_id.rpartition(":")[2]).entry_point
        creator = load_env_creator(entry) if isinstance(entry, str) else entry
        modes = getattr(creator, "metadata", {}).get("render_modes", ())
        if pictures and "rgb_array" in modes:
            kwargs.setdefault("render_mode", "rgb_array")
        return gymnasium.make(env_id, disable_env_checker=True, **kwargs)
    except Exception as error:
        raise ConfigError(
            f"the environment {env_id} cannot be made: {type(error).__name__}: {error}",
            hint="gym:ID takes the ids that gymnasium knows, or MODULE:ID, where importing MODULE registers it",
        ) from error


def _pictures(space: Any, path: str = "") -> Iterator[tuple[str, str]]:
    """Name and path of the pictures of an observation space; the name is the last part of the path."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from _pictures(part, f"{path}.{key}" if path else str(key))
    elif isinstance(space, spaces.Box) and space.dtype.name == "uint8" and space.shape[2:] == (3,):
        yield path.rpartition(".")[2] or "pixels", path


def _at(observation: Any, path: str) -> Any:
    """Raises KeyError or TypeError for a path that leads nowhere."""
    for key in path.split(".") if path else ():
        observation = observation[key]
    return observation
