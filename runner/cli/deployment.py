"""A deployment file, checked: robot, cameras, skills and task that fit together.

Every mistake is reported by line and field before a device is opened, a model loads or anything
moves. `runner.cli.deploy` composes the program.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.goals.catalogue import EXECUTABLE, Catalogue, Maker
from vram_arbiter.runner.protocols import SensorReader
from vram_arbiter.runner.recording.columns import whole_rate
from vram_arbiter.runner.recording.commit import check_folder
from vram_arbiter.runner.robots.base import HalBase
from vram_arbiter.runner.robots.body import body_of
from vram_arbiter.runner.robots.teleoperators import Teleoperator, make_teleoperator
from vram_arbiter.runner.robots.units import LerobotUnits
from vram_arbiter.runner.safety.gate import RobotGate
from vram_arbiter.runner.sensors.ros2_estop import listened_topic
from vram_arbiter.runner.sensors.world_state import JOINT_STATE
from vram_arbiter.runner.skills.wiring import wire_up
from vram_arbiter.schemas.config.robot import RobotEnvironment, VlaSpec, robot_of
from vram_arbiter.schemas.errors import ConfigError, UnknownSkill
from vram_arbiter.schemas.findings import Path as FieldPath
from vram_arbiter.schemas.manifest import Kind, ManifestError, RSkillManifest
from vram_arbiter.schemas.yamltext import Mistake, YamlText, config_error, parse_yaml, read_text


@dataclass(frozen=True, slots=True)
class DeploymentFile:
    """The file's content, and its text for the lines of mistakes that only an adapter can find."""

    robot: RobotEnvironment
    source: YamlText

    def error(self, *found: tuple[str, str]) -> ConfigError:
        """Return `(field, problem)` pairs as one error: `robot.yaml:7:
        sensors[0].backend_params.device: …`
        """
        problems = [
            Mistake(self.source.line(_path(field)), field, _on_one_line(text))
            for field, text in found
        ]
        return config_error(self.source.name, sorted(problems, key=lambda problem: problem.line))

    def merged(self, errors: Iterable[ConfigError]) -> ConfigError:
        """Several located errors as one."""
        return self.error(
            *((item["field"], item["problem"]) for e in errors for item in e.details["fields"])
        )

    def located(self, error: ConfigError, section: str) -> ConfigError:
        """Return an adapter's errors, whose fields may be relative to `section`, with this file's
        lines.
        """
        found = []
        whole = f"{error.message}; {error.hint}" if error.hint else error.message
        for item in error.details.get("fields") or [{"field": "", "problem": whole}]:
            field = str(item["field"])
            full = (
                field
                if field == section or field.startswith(f"{section}.")
                else f"{section}.{field}"
            )
            found.append((full.rstrip("."), str(item["problem"])))
        return self.error(*found)


def read_deployment(path: Path) -> DeploymentFile:
    """Read a file. Raises ConfigError: it cannot be read, or every mistake by line and field."""
    source = parse_yaml(read_text(path, hint="--config takes a deployment file"), path.name)
    return DeploymentFile(robot_of(source), source)


@dataclass(frozen=True, slots=True)
class Parts:
    """Parts of a deployment, not opened yet. The gate is the robot's own with the file's
    `safety`.
    """

    hal: HalBase
    readers: tuple[SensorReader, ...]
    gate: RobotGate
    lerobot_units: LerobotUnits | None = None  # None: lerobot does not know such a robot
    teleoperator: Teleoperator | None = None


def make_parts(file: DeploymentFile, clock: Clock) -> Parts:
    """Adapter, cameras and gate. Raises ConfigError with everything that they do not take."""
    from vram_arbiter.runner.robots.factory import make_hal
    from vram_arbiter.runner.robots.so101_kinematics import kinematics_for
    from vram_arbiter.runner.sensors.factory import make_reader

    robot = file.robot
    errors: list[ConfigError] = []
    readers: list[SensorReader] = []
    for index, sensor in enumerate(robot.sensors):
        if sensor.sensor_id == JOINT_STATE:
            errors.append(
                file.error(
                    (f"sensors[{index}].sensor_id", f"no camera may be called {JOINT_STATE}")
                )
            )
        try:
            readers.append(make_reader(sensor, clock))
        except ConfigError as error:
            errors.append(file.located(error, f"sensors[{index}]"))
    try:
        hal = make_hal(robot.hal)
    except ConfigError as error:
        raise file.merged([*errors, file.located(error, "hal")]) from error
    teleoperator = None
    if robot.teleop is not None:
        try:
            teleoperator = make_teleoperator(
                robot.teleop,
                hal.description,
                hal.lerobot_units,
                period_s=1.0 / robot.rate_hz,
                clock=clock,
            )
        except ConfigError as error:
            errors.append(file.located(error, "teleop"))
    if robot.save_dir is not None:
        try:
            whole_rate(robot.rate_hz)
            check_folder(Path(robot.save_dir))
        except ConfigError as error:
            errors.append(file.error(("save_dir", str(error))))
    if robot.save_format == "lerobot" and hal.lerobot_units is None:
        said = f"lerobot has no names and units for {hal.description.name}; use full"
        errors.append(file.error(("save_format", said)))
    try:
        gate = RobotGate(
            hal.description,
            rate_hz=robot.rate_hz,
            kinematics=kinematics_for(hal.description),
            envelopes={"safety": robot.safety},
            sent=hal.sent,
            now_ns=clock.now_ns,
        )
    except ConfigError as error:
        raise file.merged([*errors, file.located(error, "safety")]) from error
    except ImportError as error:
        text = f"its kinematics need MuJoCo: pip install 'vram-arbiter[runner]' ({error})"
        raise file.merged([*errors, file.error(("hal.adapter", text))]) from error
    if errors:
        raise file.merged(errors)
    return Parts(hal, tuple(readers), gate, hal.lerobot_units, teleoperator)


def unkept(file: DeploymentFile, parts: Parts, catalogue: Catalogue) -> tuple[str, ...]:
    """Return the safety limits of the file and of all executable skills that neither the gate nor
    the emergency stop's listener keeps.
    """
    heard = "safety.e_stop_topic (" if listened_topic(file.robot) else None
    found = dict.fromkeys(parts.gate.unkept)
    for manifest in catalogue.executable():
        found |= dict.fromkeys(parts.gate.for_skill(manifest, ()).unkept)
    return tuple(text for text in found if heard is None or not text.startswith(heard))


def contracts(parts: Parts, catalogue: Catalogue) -> list[str]:
    """Return what the policies' vectors are on this robot."""
    found = []
    for manifest in catalogue.executable():
        if manifest.kind is Kind.VLA:
            wiring = wire_up(manifest, parts.hal.description, None)
            widths = f"{wiring.actions.dim} actions from a state of {wiring.state.width}"
            found.append(f"{manifest.name}: {widths}")
    return found


# -- skills
def offered(
    file: DeploymentFile,
    parts: Parts,
    manifests: Iterable[RSkillManifest],
    makers: Mapping[Kind, Maker],
    allow_noncommercial: bool,
) -> Catalogue:
    """Return the catalogue of skills that goals may name.

    Skills that are not executed here (detectors, scene VLMs) are listed for planners; their
    licenses are checked by their sidecars. Raises ConfigError when the skill of the file's own task
    is not offered or does not fit the robot.
    """
    spec = file.robot.vla
    manifests = list(manifests)
    wanted = None if spec is None else skill_named(spec, manifests)
    kept, refused = [], {}
    for manifest in manifests:
        found = misfits(file.robot, parts, manifest)
        if manifest.kind not in EXECUTABLE:
            kept.append(manifest)
        elif why := manifest.license_refusal(allow_noncommercial=allow_noncommercial):
            refused[manifest.name] = why
        elif found and wanted != manifest.name:
            refused[manifest.name] = "; ".join(
                problem.removeprefix(f"{manifest.name}: ") for _, problem in found
            )
        else:
            kept.append(manifest)
    body = body_of(file.robot, parts.hal.description)
    catalogue = Catalogue(kept, makers, refused=refused, body=body)
    if spec is None or wanted is None:
        return catalogue
    try:
        _, _, manifest = catalogue.find(wanted)
    except UnknownSkill as error:
        raise file.error(("vla.id", str(error))) from error
    if problems := [*_contradictions(spec, manifest), *misfits(file.robot, parts, manifest)]:
        raise file.error(*problems)
    return catalogue


def skill_named(spec: VlaSpec, manifests: Iterable[RSkillManifest]) -> str:
    """Return the name of the skill that the file means: `vla.id`, else as the field writes it the
    one that `vla.weights_uri` names by name or folder (`rskills/so101-grab`)."""
    names = [manifest.name for manifest in manifests]
    folder = spec.weights_uri.rstrip("/").rpartition("/")[2]
    found = [
        name
        for name in names
        if spec.weights_uri == name
        or (folder and "://" not in spec.weights_uri and folder == _folder_of(name))
    ]
    return found[0] if spec.id not in names and len(found) == 1 else spec.id


def _folder_of(name: str) -> str:
    return name.rpartition("/")[2].removeprefix("rskill-")


def misfits(
    robot: RobotEnvironment, parts: Parts, manifest: RSkillManifest
) -> list[tuple[str, str]]:
    """Return what of a skill does not fit this robot: its envelope, and a policy's contracts and
    cameras.
    """
    problems = []
    try:
        parts.gate.for_skill(manifest, ())
    except ConfigError as error:
        problems.append(("vla.id", error.message))
    if manifest.kind is not Kind.VLA:
        return problems
    description = parts.hal.description
    try:
        wiring = wire_up(manifest, description, description.rest_pose_rad)
    except ManifestError as error:
        return [*problems, *(("vla.id", found.at(manifest.name)) for found in error.problems)]
    there = [sensor.sensor_id for sensor in robot.sensors]
    if missing := [name for name in wiring.cameras if name not in there]:
        problems.append(
            (
                "sensors",
                f"{manifest.name} needs the cameras {', '.join(missing)};"
                f" there is {', '.join(there) or 'none'}",
            )
        )
    return problems


def _contradictions(spec: VlaSpec, manifest: RSkillManifest) -> list[tuple[str, str]]:
    """Refuse fields that contradict the manifest: the sidecar loads the weights."""
    said: list[tuple[str, object, object]] = [("runtime", spec.runtime, manifest.runtime)]
    if spec.id == manifest.name:
        said.append(("weights_uri", spec.weights_uri or None, manifest.weights_uri))
    elif manifest.model_family is not None:
        said.append(("id", spec.id, manifest.model_family))
    for field in sorted(spec.quantization.model_fields_set if spec.quantization else ()):
        wanted, there = (
            getattr(block, field) for block in (spec.quantization, manifest.quantization)
        )
        said.append(("quantization", f"{field} {wanted}", f"{field} {there}"))
    return [
        (f"vla.{field}", f"{wanted} is not what {manifest.name} is installed with: {installed}")
        for field, wanted, installed in said
        if wanted is not None and str(wanted) != str(installed)
    ]


def unused(robot: RobotEnvironment) -> list[str]:
    """Return fields that are given but have no effect, with the reason."""
    notes = [
        f"embodiment_tags: {tag!r}, which no manifest can name"
        for tag in robot.embodiment_tags
        if tag not in robot.known_tags
    ]
    if "thumbnail_hz" in robot.model_fields_set:
        notes.append("thumbnail_hz: pictures are made on request")
    if robot.vla is not None:
        for field in ("device", "deterministic", "extra"):
            if field in robot.vla.model_fields_set:
                notes.append(f"vla.{field}: the policy's sidecar decides, by its own flags")
    if robot.task is not None and robot.task.scene_id:
        notes.append("task.scene_id: the scene is the real one")
    return notes


# -- for people
def plan(
    file: DeploymentFile, parts: Parts, catalogue: Catalogue, facts: Iterable[tuple[str, str]]
) -> str:
    """Describe what would run, one line per part. `facts` are lines of the calling program."""
    robot, description = file.robot, parts.hal.description
    twin = ", simulated" if description.simulated else ""
    body = body_of(robot, description)
    able = ", ".join(f"{name} {value}" for name, value in body.capabilities.items())
    lines = [
        ("robot", f"{robot.robot_id}: {description.name} by {robot.hal.adapter}{twin}"),
        (
            "body",
            f"{' and '.join(body.embodiment_tags) or 'not said: embodiment_tags is empty'}; {able}",
        ),
    ]
    lines += [
        (
            "joint",
            f"{j.name} {j.lower_rad:+.3f} … {j.upper_rad:+.3f} rad,"
            f" at most {j.max_speed_rad_s:g} rad/s",
        )
        for j in description.joints
    ]
    for sensor in robot.sensors:
        topic = f", published on {sensor.publish_topic}" if sensor.publish_topic else ""
        text = (
            f"{sensor.sensor_id} by {sensor.backend}, at most {sensor.max_age_ms:g} ms old{topic}"
        )
        lines.append(("camera", text))
    if robot.sync is not None:
        names, spread = ", ".join(robot.sync.sensor_ids), robot.sync.max_spread_ms
        lines.append(("together", f"{names}, taken within {spread:g} ms"))
    lines.append(("rate", f"{robot.rate_hz:g} Hz; late actions: {robot.deadline_overrun_policy}"))
    if robot.safety is not None:
        given = robot.safety.model_dump(exclude_unset=True)
        lines.append(("safety", ", ".join(f"{key} {value}" for key, value in given.items())))
    else:
        lines.append(("safety", "none given: only the joints' own ranges and speeds are limits"))
    if (button := listened_topic(robot)) is not None:
        lines.append(("estop", f"also by {button} (std_msgs/Bool)"))
    if robot.teleop is not None:
        lines.append(("operator", f"by {robot.teleop.adapter}, on `record` and `takeover`"))
    if asked := (*robot.ros_actions, *robot.ros_services):
        names = ", ".join(asked)
        lines.append(("actions", f"by ROS 2 servers, past this runner's gate and motors: {names}"))
    lines += [("NOT KEPT", text) for text in unkept(file, parts, catalogue)]
    lines += [("skill", text) for text in catalogue.summary()]
    lines += [("contract", text) for text in contracts(parts, catalogue)]
    if robot.task is not None and robot.vla is not None:
        limit = f", at most {robot.task.max_steps} ticks" if robot.task.max_steps else ""
        skill = skill_named(robot.vla, catalogue.executable())
        lines.append(("task", f"{robot.task.id}: {skill} {robot.task.instruction!r}{limit}"))
    if robot.save_dir is not None:
        columns = ", as lerobot-record writes it" if robot.save_format == "lerobot" else ""
        said = f"every goal, as an episode of the dataset in {robot.save_dir}{columns}"
        lines.append(("record", said))
    if robot.max_ticks is not None:
        lines.append(("end", f"after {robot.max_ticks} ticks"))
    lines += facts
    lines += [("unused", text) for text in unused(robot)]
    return "\n".join(f"{label:<9} {text}" for label, text in lines)


def _path(field: str) -> FieldPath:
    return tuple(
        int(part) if part.isdecimal() else part for part in re.findall(r"[^.\[\]]+", field)
    )


def _on_one_line(text: str) -> str:
    return " ".join(text.split())
