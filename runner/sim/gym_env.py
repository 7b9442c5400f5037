"""`GymEnv`: any gymnasium environment by its id, as an `Environment`.

Actions: what `runner.sim.gym_spaces` can write as a row of numbers, in the field of the configured
`control_mode`; an action may name its columns, in any order, as the file's `actions` do or as the
parts are called. A Discrete that is the whole action is `composite_mode`. Other spaces are refused.
An excess of at most 5 % of the range is clamped and reported, more is withheld.

Observations: pictures (uint8, height × width × 3) become cameras, the file's `joints` the joint
state; only scripted policies and recordings see the rest. The environment's code is foreign:
whatever it raises becomes EnvironmentFailed.
"""

from __future__ import annotations

import contextlib
import logging
import math
import os
import random
import reprlib
from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from vram_arbiter.runner.protocols import Stepped
from vram_arbiter.runner.sim.environment import EnvStep
from vram_arbiter.runner.sim.gym_config import RENDER, SUCCESS_KEYS, GymConfig
from vram_arbiter.runner.sim.gym_spaces import ActionRow, Leaf, NoNumbers, leaves
from vram_arbiter.schemas.control import ControlMode
from vram_arbiter.schemas.errors import ConfigError, EnvironmentFailed, ModelError
from vram_arbiter.schemas.world import PAYLOAD_OF_MODE, Action, JointState, SensorFrame, WorldState

log = logging.getLogger(__name__)

# numbers of a recorded part; beyond that it is a depth map, a point cloud or the like
SHOWN_MAX = 4096
CLAMP_SHARE = 0.05  # of a number's range: an aim at the stop; beyond it a mistake


@dataclass(frozen=True, slots=True)
class SpaceGate:
    """The limits of an action space, as a gate."""

    mode: ControlMode
    low: tuple[float, ...]
    high: tuple[float, ...]
    names: tuple[str, ...]

    def check(self, action: Action, world: WorldState) -> tuple[Action | None, tuple[str, ...]]:
        """Return the action to apply, clamped where the excess is small, or None; and the
        violations.
        """
        if action.control_mode is not self.mode or (
            action.body_twist is not None and self.mode is not ControlMode.BODY_TWIST
        ):
            return None, (f"this environment takes {self.mode}, not {action.control_mode}",)
        if action.horizon != 1:
            return None, (f"one step at a time, not {action.horizon}",)
        row = self.in_order(action)
        if isinstance(row, str):
            return None, (row,)
        problems, withheld, values = [], False, []
        if not all(map(math.isfinite, row)):  # copies of an action are not validated
            return None, (f"an action with numbers that are not finite: {row}",)
        for name, value, low, high in zip(self.names, row, self.low, self.high, strict=True):
            excess = max(low - value, value - high, 0.0)
            if excess > 0:
                problems.append(f"{name}: {value:.4g} is outside [{low:.4g}, {high:.4g}]")
                withheld |= excess > CLAMP_SHARE * (high - low)
            values.append(min(max(value, low), high))
        if withheld:
            return None, tuple(problems)
        payload = tuple(values) if self.mode is ControlMode.COMPOSITE_MODE else (tuple(values),)
        update = {PAYLOAD_OF_MODE[self.mode]: payload, "joint_names": None}
        return action.model_copy(update=update), tuple(problems)

    def in_order(self, action: Action) -> tuple[float, ...] | str:
        """Return the row in the environment's order, or why there is none."""
        if self.mode is ControlMode.COMPOSITE_MODE:
            return (action.rows[0],)
        row: tuple[float, ...] = action.rows[0]
        if len(row) != len(self.low):
            return f"{len(row)} numbers for an action of {len(self.low)}"
        if action.joint_names is None:
            return row
        if set(action.joint_names) != set(self.names):
            given, known = ", ".join(action.joint_names), ", ".join(self.names)
            return f"actions are named {given}; the environment knows {known}"
        named = dict(zip(action.joint_names, row, strict=True))
        return tuple(named[name] for name in self.names)


class GymEnv:
    """`GymEnv("CartPole-v1", GymConfig())`.

    `render`: whether its `render()` is offered as a camera; None: where that works. Raises
    ConfigError for an id, a file or spaces that do not fit.
    """

    def __init__(
        self, env_id: str, config: GymConfig | None = None, *, render: bool | None = None
    ) -> None:
        self.env_id = env_id
        self.config = config or GymConfig()
        self._render_wanted = render
        self._env = _make(env_id, self.config, pictures=render is not False)
        self._last = EnvStep()
        self._total_reward = 0.0
        self._steps = 0
        self._observation: Any = None
        self._sent: dict[str, float] = {}
        kind, _, least = self.config.success.partition(":")
        self._unearned = kind == "return" and float(least) <= 0  # doing nothing has that return
        try:
            self._check_spaces()
            self._row = self._action_row()
            self._gate = self._make_gate()
            self._hold = None if self.config.hold is None else self._held(self.config.hold)
            self._observed = self._parts_observed()
            # camera → its part of the observation; None: what `render()` gives
            self._views = self._views_of()
            self._state = self._state_parts()
            self._shown = self._shown_parts()
            # a file that names some needs no list of the rest
            self._said_what_is_shown = bool(self.config.joints)
        except BaseException:
            self.close()
            raise

    # -- what the spaces say
    def _check_spaces(self) -> None:
        from gymnasium import Space

        for what in ("action_space", "observation_space"):
            if not isinstance(getattr(self._env, what, None), Space):
                raise ConfigError(
                    f"{self.env_id} has no {what}: its actions and observations are unknown"
                )

    def _action_row(self) -> ActionRow:
        try:
            return ActionRow(self._env.action_space)
        except NoNumbers as error:
            raise ConfigError(
                f"{self.env_id} takes actions that are no row of numbers: {error}",
                hint="Box, Discrete, MultiDiscrete and MultiBinary can be driven,"
                " also in Dict and Tuple;"
                " wrap the environment to change others",
            ) from error

    def _make_gate(self) -> SpaceGate:
        from gymnasium import spaces

        row, names = self._row, self.config.actions
        if names and len(names) != len(row.names):
            raise ConfigError(
                f"{len(names)} names in `actions` for {self.env_id}'s actions of {len(row.names)}"
            )
        single = isinstance(self._env.action_space, spaces.Discrete)
        mode = ControlMode.COMPOSITE_MODE if single else self.config.control_mode
        return SpaceGate(mode, row.low, row.high, names or row.names)

    def _held(self, raw: Any) -> Action:
        try:
            action = self.action_of(raw)
        except ModelError as error:
            raise ConfigError(
                f"`hold` is not an action of {self.env_id}: {error.message}"
            ) from error
        if problems := self._gate.check(action, WORLDLESS)[1]:
            raise ConfigError(f"`hold` is not an action of {self.env_id}: {problems[0]}")
        return action

    def _parts_observed(self) -> dict[str, Leaf]:
        parts = list(leaves(self._env.observation_space))
        if twice := [
            path for path, count in Counter(part.path for part in parts).items() if count > 1
        ]:
            raise ConfigError(f"two parts of {self.env_id}'s observation are called {twice[0]}")
        return {part.path: part for part in parts}

    def _views_of(self) -> dict[str, Leaf | None]:
        """Name pictures by the last key of their path; by the whole path where it is shared or
        missing.
        """
        pictures = {path: part for path, part in self._observed.items() if part.picture}
        views: dict[str, Leaf | None] = {}
        for name, path in self.config.cameras.items():
            if path != RENDER and path not in pictures:
                raise ConfigError(
                    f"camera {name}: {self.env_id} observes no picture at {path!r}",
                    hint=f"choose from {', '.join([*pictures, RENDER])}",
                )
            views[name] = pictures.get(path)
        last = {path: part.keys[-1] if part.keys else PIXELS for path, part in pictures.items()}
        count = Counter(last.values())
        found = {
            last[path] if count[last[path]] == 1 and isinstance(last[path], str) else path: part
            for path, part in pictures.items()
        }
        return views or {**found}

    def _state_parts(self) -> tuple[Leaf, ...]:
        """Return the places of the joints. Raises ConfigError when they are nowhere."""
        if not self.config.joints:
            return ()
        at, hint = (
            self.config.state,
            "`state` is the path of the vector that holds the joints, or of parts that do",
        )
        parts = tuple(
            p
            for path, p in self._observed.items()
            if not at or path == at or path.startswith(f"{at}.")
        )
        if not parts:
            raise ConfigError(
                f"{self.env_id} has no numbers at {at!r}: there is no such part", hint=hint
            )
        for part in parts:
            if part.picture and part.path != at:
                raise ConfigError(
                    f"{self.env_id} has no numbers at {at!r}: {part.path} is a picture", hint=hint
                )
        try:
            size = sum(part.size for part in parts)
        except NoNumbers as error:
            raise ConfigError(
                f"{self.env_id} has no numbers at {at!r}: {error}", hint=hint
            ) from error
        for name, index in (*self.config.joints.items(), *self.config.velocities.items()):
            if index >= size:
                raise ConfigError(f"joint {name} has index {index} in the {size} numbers at {at!r}")
        return parts

    def _shown_parts(self) -> tuple[Leaf, ...]:
        """Return every part that is made of numbers, except pictures."""
        shown = []
        for part in self._observed.values():
            with contextlib.suppress(NoNumbers):
                if 0 < part.size <= SHOWN_MAX and not part.bytes_in_a_plane:
                    shown.append(part)
        names = Counter(name for part in shown for name in part.names("observation"))
        if twice := [name for name, count in names.items() if count > 1]:
            raise ConfigError(f"two numbers of {self.env_id}'s observation are called {twice[0]}")
        return tuple(shown)

    # -- Environment
    def reset(self, seed: int) -> None:
        self._steps, self._total_reward, self._sent = 0, 0.0, {}
        # not the same seed: both draw from the same kind of generator, and random actions would be
        # the world's own random numbers
        actions_seed = random.Random(f"actions-{seed}").getrandbits(31)
        try:
            self._env.action_space.seed(actions_seed)
            self._observation, info = self._env.reset(seed=seed)
        except Exception as error:
            raise self._failed("reset", error) from error
        self._check_observation()
        self._last = EnvStep(success=self._success(info))
        if self._render_wanted is None:
            self._render_wanted = self._can_render()
        if self._render_wanted and not self.config.cameras:
            self._views.setdefault(RENDER, None)

    def _check_observation(self) -> None:
        """Check that what is read fits its space. Raises EnvironmentFailed."""
        try:
            for part in self._state:
                part.numbers(self._observation)
        except NoNumbers as error:
            raise EnvironmentFailed(
                f"{self.env_id} observed something else than promised: {error}"
            ) from error
        for camera, view in self._views.items():
            if view is None:
                continue
            try:
                picture = view.of(self._observation)
                as_promised = (
                    picture.dtype == view.space.dtype and picture.shape == view.space.shape
                )
            except (NoNumbers, AttributeError):
                as_promised = False
            if not as_promised:
                raise EnvironmentFailed(
                    f"{self.env_id} observed no picture for {camera} as {view.space} promises"
                )

    def observe(self, stamp_ns: int, frames: Mapping[str, SensorFrame] | None) -> WorldState:
        joints, velocities = self.config.joints, self.config.velocities
        vector = [number for part in self._state for number in part.numbers(self._observation)]
        return WorldState(
            stamp_ns=stamp_ns,
            joint_state=JointState(
                name=tuple(joints),
                position=tuple(vector[index] for index in joints.values()),
                velocity=tuple(vector[velocities[name]] for name in joints) if velocities else (),
                stamp_ns=stamp_ns,
            ),
            image_frames=dict(frames) if frames is not None else None,
        )

    def shown(self) -> dict[str, float]:
        """Return the joints (rad) where the file names some; else all observed numbers in their own
        units.
        """
        joints, parts = self.config.joints, self._state or self._shown
        if not self._said_what_is_shown:
            self._said_what_is_shown = True
            kept = {
                *(part.path for part in parts),
                *(view.path for view in self._views.values() if view),
            }
            if left := [part for path, part in self._observed.items() if path not in kept]:
                text = ", ".join(
                    f"{part.path or 'itself'} ({type(part.space).__name__})" for part in left
                )
                log.warning("%s: not recorded of its observation: %s", self.env_id, text)
        try:
            numbers = [number for part in parts for number in part.numbers(self._observation)]
        except NoNumbers as error:
            raise EnvironmentFailed(
                f"{self.env_id} observed something else than promised: {error}"
            ) from error
        if joints:
            return {name: numbers[index] for name, index in joints.items()}
        return dict(
            zip(
                (name for part in parts for name in part.names("observation")), numbers, strict=True
            )
        )

    @property
    def acted(self) -> dict[str, float]:
        """Numbers of the last step's action as they passed the gate, by name."""
        return self._sent

    def step(self, action: Action | None) -> EnvStep:
        self._sent = {}
        if action is None:
            action = self._hold
        if action is None:
            return EnvStep(success=self._last.success, moved=False, unearned=self._unearned)
        row = self._gate.in_order(action)
        if isinstance(row, str):
            raise EnvironmentFailed(f"an action that the gate has not seen: {row}")
        raw = self._row.element(row)
        try:
            self._observation, given, terminated, truncated, info = self._env.step(raw)
            reward, terminated, truncated = float(given), bool(terminated), bool(truncated)
        except Exception as error:
            raise self._failed("step", error) from error
        self._check_observation()
        if not math.isfinite(reward):
            raise EnvironmentFailed(f"{self.env_id} gave the reward {reward}")
        self._sent = dict(zip(self._gate.names, row, strict=True))
        self._steps += 1
        self._total_reward += reward
        self._last = EnvStep(
            reward, terminated, truncated, self._success(info), unearned=self._unearned
        )
        return self._last

    def gate(self, skill: Stepped) -> SpaceGate:
        """Return the gate: the action space is the only known limit.

        What the skill's envelope asks for beyond it is logged once per goal.
        """
        envelope = None if skill.manifest is None else skill.manifest.envelope
        if envelope is not None and envelope.model_fields_set:
            asked = ", ".join(sorted(envelope.model_fields_set))
            log.warning("%s: not kept in %s: %s", skill.key, self.env_id, asked)
        return self._gate

    def action_of(self, raw: Any) -> Action:
        """Convert what the environment itself takes.

        A number of a Discrete, the numbers of a Box (any shape that has as many), a map for a Dict.
        """
        mode = self._gate.mode
        try:
            row = tuple(self._row.row_of(raw))
        except NoNumbers as error:
            raise ModelError(
                f"expected an action of {self.env_id}, got {reprlib.repr(raw)}: {error}"
            ) from error
        payload = row if mode is ControlMode.COMPOSITE_MODE else (row,)
        return Action.model_validate({"control_mode": mode, PAYLOAD_OF_MODE[mode]: payload})

    def sample(self) -> Action:
        try:
            drawn = self._env.action_space.sample()
        except Exception as error:
            raise self._failed("action_space.sample", error) from error
        return self.action_of(drawn)

    @property
    def observation(self) -> Any:
        """The last observation, as gymnasium gives it."""
        return self._observation

    @property
    def targets(self) -> dict[str, float]:
        return {}  # its actions are its own affair

    @property
    def cameras(self) -> tuple[str, ...]:
        return tuple(self._views)

    @property
    def clock_text(self) -> str:
        return f"step {self._steps}, return {self._total_reward:.2f}"

    # -- pictures
    def render(self, camera: str) -> Any:
        import numpy as np

        if camera not in self._views and camera != RENDER:
            raise KeyError(camera)
        if (view := self._views.get(camera)) is not None:
            # a copy: some environments draw over their last one
            return np.array(view.of(self._observation), order="C")
        try:
            picture = self._env.render()
        except Exception as error:
            raise self._failed("render", error) from error
        if (
            not isinstance(picture, np.ndarray)
            or picture.shape[2:] != (3,)
            or picture.dtype != np.uint8
        ):
            raise EnvironmentFailed(
                f"{self.env_id} renders no picture (uint8, height × width × 3)",
                hint="it needs the render mode rgb_array;"
                " leave videos out, or name a camera of its observation",
            )
        return np.array(picture, order="C")

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

    # -- judging
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
        """Return a verdict from a truth value or a whole number.

        Raises EnvironmentFailed for others.
        """
        import numpy as np

        plain = np.asarray(value)
        if plain.size == 1 and plain.dtype.kind in "biuf" and float(plain.item()).is_integer():
            return bool(plain.item())
        raise EnvironmentFailed(
            f"{self.env_id} says {value!r} of {key}, which is neither yes nor no",
            hint="choose what a success is with `success`:"
            " info:KEY of a truth value, or return:NUMBER",
        )

    def _failed(self, what: str, error: Exception) -> EnvironmentFailed:
        return EnvironmentFailed(f"{self.env_id}.{what}: {type(error).__name__}: {error}")


PIXELS = "pixels"  # an observation that is nothing but a picture
WORLDLESS = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))


def _make(env_id: str, config: GymConfig, *, pictures: bool) -> Any:
    os.environ.setdefault("MUJOCO_GL", "egl")  # no display is needed by default
    os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
    try:
        import gymnasium
        from gymnasium.envs.registration import load_env_creator
    except ImportError as error:
        raise ConfigError(
            "gymnasium is not installed", hint="pip install 'vram-arbiter[runner]'"
        ) from error
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
            hint="gym:ID takes the ids that gymnasium knows, or MODULE:ID,"
            " where importing MODULE registers it",
        ) from error
