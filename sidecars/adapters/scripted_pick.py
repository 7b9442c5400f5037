"""A scripted pick in the place of a learned policy: the wire and the contract are a policy's.

Stands in where no checkpoint can be had (`policy_extras.adapter: scripted_pick`), for a mobile
manipulator with the field's `human300_16d` state and 12-slot action. It sees what a policy sees: it
finds the object by its color in the camera's picture, whose place on the base it is told, and works
by the measured poses from there. It computes on the CPU; a GPU is charged by its footprint alone.
"""

from __future__ import annotations

import enum
import math
from typing import TYPE_CHECKING, Any, Final, Literal

from pydantic import BaseModel, ConfigDict, ValidationError

from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.sidecar import EndpointCall
from vram_arbiter.sidecars.adapters.base import ModelCall
from vram_arbiter.sidecars.adapters.policy_observations import (
    ACTION,
    IMAGE_PREFIX,
    STATE,
    numbers_of,
    observation_of,
    pixels_of,
)

if TYPE_CHECKING:
    from numpy.typing import NDArray

ADAPTER: Final = "scripted_pick"
CHUNK: Final = 10  # actions of an answer
# OpenCV's hue (0..179) of the colors that it knows, far enough apart for shade and light
HUES: Final = {"red": 0, "orange": 13, "yellow": 27, "green": 64, "blue": 114, "purple": 143}
HUE_WITHIN, SATURATION_MIN, PIXELS_MIN = 7, 140, 12
BASE_WITHIN_M, BASE_SPEED_M_S, BASE_GAIN_PER_S = 0.008, 0.15, 2.0
TOOL_WITHIN_M, TOOL_STEP_M = 0.006, 0.012  # the longest way of one action
TOOL_SHARE = 0.2  # of the way left that an action goes: chunks end slowly, so that the arm follows
OPEN, CLOSED = -1.0, 1.0
MANIPULATE, NAVIGATE = -1.0, 1.0


class Phase(enum.Enum):
    """Where the pick stands. An empty hand after `LIFT` is the caller's to notice."""

    ALIGN = enum.auto()
    HOVER = enum.auto()
    DESCEND = enum.auto()
    CLOSE = enum.auto()
    LIFT = enum.auto()


class Setup(BaseModel):
    """`policy_extras.scripted_pick`: camera and places in the base's frame, in meters.

    `plane_z_m` is the height of an object's middle, `low_z_m` that of the tool when it closes.
    `delta_scale_m` are the meters of one unit of the action, `period_s` is a control step.
    """

    model_config = ConfigDict(extra="forbid", frozen=True, allow_inf_nan=False)

    camera: str
    fovy_deg: float
    pos_m: tuple[float, float, float]
    look_at_m: tuple[float, float, float]
    plane_z_m: float
    low_z_m: float
    spot_m: tuple[float, float]
    hover_m: float = 0.10
    lift_m: float = 0.15
    delta_scale_m: float = 0.05
    period_s: float = 1 / 30


class ScriptedPickAdapter:
    """The endpoints `get_action` and `reset`: `action` is float32 (CHUNK, 12), in the contract of
    pi05-robocasa365 (six tool deltas, gripper, three base velocities, unused, composite mode).

    Raises ConfigError for a wrong `policy_extras.scripted_pick`.
    """

    kind: Literal["vla"] = "vla"
    ops = frozenset({"get_action", "reset"})
    modules = ("cv2",)
    networks = ()

    def __init__(self, manifest: RSkillManifest) -> None:
        try:
            self._setup = Setup.model_validate(manifest.policy_extras.get(ADAPTER))
        except ValidationError as error:
            found = error.errors()[0]
            field = ".".join(map(str, (ADAPTER, *found["loc"])))
            raise ConfigError(f"{manifest.name}: policy_extras.{field}: {found['msg']}") from error
        self._target: Any = None  # of the object, x and y in the world frame
        self._phase = Phase.ALIGN
        self._closing = 0

    def prepare(self) -> None:
        import cv2  # noqa: F401  its import time belongs here

    def load(self, device: str) -> None:
        pass

    def place(self, device: str) -> None:
        pass

    def run(self, call: ModelCall) -> Message:
        """Answer a chunk. Raises BadRequest for an incomplete observation or a task without a
        color, ModelError where the picture does not show that color.
        """
        assert isinstance(call, EndpointCall)
        if call.endpoint == "reset":
            self._target, self._phase, self._closing = None, Phase.ALIGN, 0
            return {"ok": True, "n_action_steps": CHUNK, "n_obs_steps": 1}
        observation = observation_of(call)
        state = numbers_of(STATE, observation.get(STATE), "send the layout human300_16d")
        if state.shape != (16,):
            raise BadRequest(f"{STATE} must have 16 numbers (human300_16d), not {state.shape}")
        if self._target is None:
            self._target = _to_world(state, self._look(observation))
        return {ACTION: self._chunk(state)}

    # -- eyes
    def _look(self, observation: JsonMap) -> Any:
        """Return the place (x, y in the base's frame) of the thing of the task's color that is
        nearest to the grasp spot."""
        import cv2
        import numpy as np

        words = str(observation.get("task", "")).lower().split()
        color = next((word for word in words if word in HUES), None)
        if color is None:
            raise BadRequest(
                f"the task {' '.join(words)!r} names no color", hint=f"use one of {', '.join(HUES)}"
            )
        name = IMAGE_PREFIX + self._setup.camera
        pixels = pixels_of(name, observation.get(name))
        hue, saturation, _ = cv2.split(cv2.cvtColor(np.array(pixels), cv2.COLOR_RGB2HSV))
        apart = np.abs((hue.astype(int) - HUES[color] + 90) % 180 - 90)
        mask = ((apart <= HUE_WITHIN) & (saturation >= SATURATION_MIN)).astype(np.uint8)
        count, _, boxes, _ = cv2.connectedComponentsWithStats(mask)
        places = [
            self._on_plane(x + width / 2, y + height / 2, pixels.shape)
            for x, y, width, height, area in boxes[1:count].tolist()
            if area >= PIXELS_MIN
        ]
        if not places:
            raise ModelError(f"nothing {color} is in the picture of {self._setup.camera}")
        return min(places, key=lambda place: math.dist(place, self._setup.spot_m))

    def _on_plane(self, u: float, v: float, shape: tuple[int, ...]) -> tuple[float, float]:
        """Return where the ray through a pixel meets the height of an object's middle."""
        import numpy as np

        setup = self._setup
        eye = np.array(setup.pos_m)
        ahead = np.array(setup.look_at_m) - eye
        ahead /= np.linalg.norm(ahead)
        right = np.cross(ahead, (0.0, 0.0, 1.0))
        right /= np.linalg.norm(right)
        focal = shape[0] / 2 / math.tan(math.radians(setup.fovy_deg) / 2)
        across, down = (u - shape[1] / 2) / focal, (v - shape[0] / 2) / focal
        ray = ahead + across * right + down * np.cross(ahead, right)
        met = eye + ray * (setup.plane_z_m - eye[2]) / ray[2]
        return float(met[0]), float(met[1])

    # -- motion
    def _chunk(self, state: Any) -> Any:
        import numpy as np

        setup, tool = self._setup, state[:3]
        object_xy = _to_base(state, self._target)
        aside = object_xy - np.array(setup.spot_m)
        goals = {
            Phase.HOVER: setup.low_z_m + setup.hover_m,
            Phase.DESCEND: setup.low_z_m,
            Phase.CLOSE: setup.low_z_m,
            Phase.LIFT: setup.low_z_m + setup.lift_m,
        }

        def left() -> Any:
            return np.array([*object_xy, goals[self._phase]]) - tool

        if self._phase is Phase.ALIGN and math.hypot(*aside) < BASE_WITHIN_M:
            self._phase = Phase.HOVER
        elif self._phase is Phase.HOVER and np.linalg.norm(left()) < TOOL_WITHIN_M:
            self._phase = Phase.DESCEND
        elif self._phase is Phase.DESCEND and np.linalg.norm(left()) < TOOL_WITHIN_M:
            self._phase = Phase.CLOSE
        elif self._phase is Phase.CLOSE:
            self._closing += 1
            if self._closing > 1:  # two chunks: the fingers have met the object
                self._phase = Phase.LIFT
        actions: NDArray[Any] = np.zeros((CHUNK, 12), dtype=np.float32)
        actions[:, 6] = CLOSED if self._phase in (Phase.CLOSE, Phase.LIFT) else OPEN
        actions[:, 11] = NAVIGATE if self._phase is Phase.ALIGN else MANIPULATE
        if self._phase is Phase.ALIGN:
            _drive(actions, aside, setup.period_s)
        elif self._phase is not Phase.CLOSE:
            _move(actions, left(), setup.delta_scale_m)
        return actions


def _drive(actions: Any, way: Any, period_s: float) -> None:
    """Write base velocities that go `way` (m, x and y in the base's frame)."""
    for row in actions:
        speed = BASE_GAIN_PER_S * way
        speed *= min(1.0, BASE_SPEED_M_S / max(math.hypot(*speed), 1e-9))
        row[7:9] = speed
        way = way - speed * period_s


def _move(actions: Any, way: Any, scale_m: float) -> None:
    """Write tool deltas that go `way` (m, along the base's axes)."""
    for row in actions:
        step = TOOL_SHARE * way
        step *= min(1.0, TOOL_STEP_M / max(math.hypot(*step), 1e-9))
        row[:3] = step / scale_m
        way = way - step


def _turned(state: Any, xy: Any, sign: int) -> Any:
    """Return a vector turned by the base's yaw, or back."""
    import numpy as np

    x, y, z, w = state[10:14]
    yaw = sign * math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))
    cos, sin = math.cos(yaw), math.sin(yaw)
    return np.array([cos * xy[0] - sin * xy[1], sin * xy[0] + cos * xy[1]])


def _to_world(state: Any, xy: Any) -> Any:
    return state[7:9] + _turned(state, xy, 1)


def _to_base(state: Any, xy: Any) -> Any:
    return _turned(state, xy - state[7:9], -1)
