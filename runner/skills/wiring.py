"""What a policy's manifest needs of this robot, found out before anything moves.

`wire_up` reads cameras, joints, vectors and the rollout, with a finding for each part that does not
fit.
"""

from __future__ import annotations

import importlib
from collections.abc import Mapping
from dataclasses import dataclass

from pydantic import BaseModel, ConfigDict, Field, JsonValue, ValidationError

from vram_arbiter.clients.sidecar.openpi import Template
from vram_arbiter.runner.protocols import RobotDescription
from vram_arbiter.runner.skills.action_contract import needs_frames as actions_need_frames
from vram_arbiter.runner.skills.action_contract import plan_actions
from vram_arbiter.runner.skills.actions import ActionPlan
from vram_arbiter.runner.skills.kinematics import ArmModel
from vram_arbiter.runner.skills.states import StatePlan, plan_state, reads_poses
from vram_arbiter.runner.skills.states import needs_frames as state_needs_frames
from vram_arbiter.schemas.control import JOINT_MODES
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.findings import Problem
from vram_arbiter.schemas.manifest import ManifestError, RSkillManifest
from vram_arbiter.schemas.manifest.manifest import IMAGES_PREFIX
from vram_arbiter.schemas.sidecar import LEFT_OVER_MAX

STATE, TASK = "observation.state", "task"
OPENPI = "openpi"  # of `policy_extras.adapter`: a server of that project; any other: a sidecar's
ROLLOUT_S = 5.0  # of motion, unless the manifest says otherwise


class View(BaseModel):
    """Crop in fractions of the picture (x0, y0, x1, y1) and the size it is averaged down to."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    crop: tuple[float, float, float, float] = (0.0, 0.0, 1.0, 1.0)
    size_px: tuple[int, int] | None = None


class RealTime(BaseModel):
    """Real-time chunking: the first `execution_horizon` rows of a chunk continue the one before."""

    model_config = ConfigDict(extra="forbid", frozen=True)
    execution_horizon: int = Field(default=10, ge=1, le=LEFT_OVER_MAX)  # lerobot's own default


class Rollout(BaseModel):
    """Part of `policy_extras` that the runner reads; other keys belong to the sidecar's adapter."""

    model_config = ConfigDict(extra="ignore", frozen=True)
    rollout_steps: int | None = Field(
        default=None, ge=1, le=100_000
    )  # None: latency_budget.max_execution_s
    stop_when_still: bool = True
    views: dict[str, View] = Field(default_factory=dict)
    prefetch_at: int = Field(default=0, ge=0, le=1000)
    rtc: RealTime | None = None  # for policies that lerobot guides by the chunk before
    n_obs_steps: int | None = Field(
        default=None, ge=1, le=16
    )  # consecutive observations that a chunk needs; None: as many as the sidecar says, else 1
    adapter: str = ""
    openpi_observation: dict[str, JsonValue] = Field(default_factory=dict)
    """What openpi's server is shown (`clients.sidecar.openpi.Template`)."""
    targets_lead: bool = (
        False  # its targets are set points far ahead of the arm: a robot goes there step by step
    )


@dataclass(frozen=True, slots=True)
class Wiring:
    """Map from a manifest's features to this robot: cameras, joints, start pose (rad), and what
    its vectors mean. `model` where a contract speaks of frames.
    """

    cameras: Mapping[str, str]
    robot: RobotDescription
    start_pose: Mapping[str, float] | None  # None: it begins where the robot stands
    actions: ActionPlan
    state: StatePlan
    model: ArmModel | None
    steps_per_chunk: int | None
    rollout: Rollout
    rollout_s: float

    @property
    def joints(self) -> tuple[str, ...]:
        """Return the joints that are commanded, in the order of their targets."""
        return self.actions.joints


def wire_up(
    manifest: RSkillManifest,
    robot: RobotDescription,
    rest: Mapping[str, float] | None,
) -> Wiring:
    """Read the manifest.

    Raises ManifestError with a finding for each part that this robot cannot do or tell.
    """
    problems = manifest.not_executable()
    cameras = _cameras(manifest)
    order, found = _joint_order(manifest, robot)
    model, lost = _model(manifest, robot)
    problems += found
    problems += lost
    actions, found = plan_actions(manifest, robot, order, model)
    state, others = plan_state(manifest, robot, order, model)
    if not lost:  # else all of them say the same
        problems += [*found, *others]
    start = rest
    if manifest.starting_pose is not None:
        if len(manifest.starting_pose) != len(order):
            problems.append(Problem(("starting_pose",), f"must give {len(order)} joints"))
        else:
            start = dict(zip(order, manifest.starting_pose, strict=True))
    rollout = Rollout()
    try:
        rollout = Rollout.model_validate(manifest.policy_extras)
    except ValidationError as error:
        problems.append(Problem(("policy_extras",), error.errors()[0]["msg"]))
    if rollout.rtc is not None and not rollout.prefetch_at:
        problems.append(
            Problem(
                ("policy_extras", "rtc"),
                "needs prefetch_at: a chunk that is asked for after the last action has none to "
                "continue",
            )
        )
    problems += _openpi_problems(rollout, {*cameras.values(), STATE, TASK})
    if manifest.chunk_size and rollout.prefetch_at >= manifest.chunk_size:
        problems.append(
            Problem(
                ("policy_extras", "prefetch_at"),
                f"must be less than chunk_size, {manifest.chunk_size}: all of a chunk would be "
                "past when it is due",
            )
        )
    if problems:
        raise ManifestError(manifest.name, problems)
    rollout_s = manifest.latency_budget.max_execution_s or ROLLOUT_S
    return Wiring(
        cameras,
        robot,
        start,
        actions,
        state,
        model,
        manifest.n_action_steps,
        rollout,
        rollout_s,
    )


def _openpi_problems(rollout: Rollout, there: set[str]) -> list[Problem]:
    """Return what an openpi server is to be shown and is not `there`."""
    path = ("policy_extras", "openpi_observation")
    if rollout.adapter != OPENPI:
        return []
    try:
        names = Template(rollout.openpi_observation).names
    except ValueError as error:
        return [Problem(path, str(error))]
    if not names:
        return [Problem(path, "is required with adapter: openpi")]
    if unknown := sorted(names - there):
        return [Problem(path, f"shows {', '.join(unknown)}; there is {', '.join(sorted(there))}")]
    return []


def _cameras(manifest: RSkillManifest) -> dict[str, str]:
    """Return the key of each of the robot's cameras: the sidecar renames it to what the checkpoint
    calls it.
    """
    aliases = manifest.image_preprocessing.aliases if manifest.image_preprocessing else {}
    robot_name = {model: robot for robot, model in aliases.items()}
    cameras = {}
    for key in manifest.camera_keys:
        name = key.rpartition(".")[2]
        camera = robot_name.get(name, name)
        cameras[camera] = IMAGES_PREFIX + camera
    return cameras


def _joint_order(
    manifest: RSkillManifest, robot: RobotDescription
) -> tuple[tuple[str, ...], list[Problem]]:
    """Return the joints in the policy's order, the robot's where the manifest gives none."""
    for index, actuator in enumerate(manifest.actuators_required):
        order = actuator.control_mode_semantics.joint_order
        if order is None or actuator.kind not in JOINT_MODES:
            continue
        path = ("actuators_required", index, "control_mode_semantics", "joint_order")
        if set(order) <= set(robot.joint_names) and len(set(order)) == len(order):
            return order, []
        return robot.joint_names, [
            Problem(
                path,
                f"moves {', '.join(order)}; the robot has {', '.join(robot.joint_names)}",
            )
        ]
    return robot.joint_names, []


def _model(
    manifest: RSkillManifest, robot: RobotDescription
) -> tuple[ArmModel | None, list[Problem]]:
    """Return the robot's model if a contract speaks of frames and there is one."""
    solving, state = actions_need_frames(manifest), manifest.state_contract
    if not (solving or reads_poses(state)):
        return None, []
    path = ("action_contract",) if solving else ("state_contract",)
    try:
        importlib.import_module("scipy.spatial.transform")  # no tick has the time for it
        if not robot.model or not (solving or state_needs_frames(state)):
            return None, []
        if solving:
            importlib.import_module("mink")
        return ArmModel(robot), []
    except ImportError as error:
        what = f"frames need mink and SciPy ({error}): pip install 'vram-arbiter[runner]'"
        return None, [Problem(path, what)]
    except ConfigError as error:
        return None, [Problem(path, error.message)]
