"""Installed skills: manifests by name, which of them a goal may execute, and their makers.

Only kinds that move something can be executed: never a detector, a scene VLM or a reward model.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path

from vram_arbiter.runner.protocols import Skill, SkillKey
from vram_arbiter.runner.skills.ros_standins import StandIns
from vram_arbiter.schemas.body import Body
from vram_arbiter.schemas.errors import ManifestInvalid, UnknownSkill
from vram_arbiter.schemas.manifest import Kind, ManifestError, RSkillManifest, load_manifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.endpoints import program_endpoint, sidecar_name

EXECUTABLE = frozenset({Kind.VLA, Kind.ROS_ACTION, Kind.ROS_SERVICE})
NOT_EXECUTED = {
    Kind.DETECTOR: "a planner asks it for things in a picture",
    Kind.SEGMENTER: "it is asked about a picture, and nothing here serves it",
    Kind.VLM: "a planner asks it about a picture",
    Kind.REWARD: "it judges progress and moves nothing",
    Kind.PLAYBOOK: "it is a text for planners",
    Kind.WAM: "nothing here runs world action models",
}
UNMADE = {
    Kind.VLA: "nothing here makes learned policies",
    Kind.ROS_ACTION: "this runner neither stands in for it nor asks a ROS 2 server",
    Kind.ROS_SERVICE: "only a robot's deployment asks ROS 2 servers",
}
MOTION_S = 45.0  # of a goal when neither it nor its manifest says how long
# before the motion: other models finish and leave, a model loads, the arm goes to its start
START_S = 90.0
FILE_NAME = "rskill.yaml"

Maker = Callable[[RSkillManifest], Skill]


def read_manifests(paths: Iterable[Path]) -> list[RSkillManifest]:
    """Read manifests from files, or from folders that hold `rskill.yaml` files at any depth.

    Raises ManifestInvalid for a wrong one, or if there are none.
    """
    files: list[Path] = []
    for path in paths:
        files += sorted(path.rglob(FILE_NAME)) if path.is_dir() else [path]
    manifests: dict[str, RSkillManifest] = {}
    for file in files:
        try:
            manifest = load_manifest(file)
        except ManifestError as error:
            raise ManifestInvalid(
                str(error), hint="`python -m vram_arbiter.schemas check FILE` shows every finding"
            ) from error
        if manifest.name in manifests:
            raise ManifestInvalid(f"{manifest.name} is installed twice, again by {file}")
        manifests[manifest.name] = manifest
    if not manifests:
        raise ManifestInvalid(
            "no skill is installed", hint=f"--skills takes folders with {FILE_NAME} files"
        )
    return list(manifests.values())


class Catalogue:
    """`makers` make the skills of a kind; kinds without a maker are listed but not executed.

    `refused` names skills that are installed but not offered here, with the reason. `body` is the
    robot's: skills for other bodies are listed and refused; None accepts all.
    """

    def __init__(
        self,
        manifests: Iterable[RSkillManifest],
        makers: Mapping[Kind, Maker],
        *,
        refused: Mapping[str, str] | None = None,
        body: Body | None = None,
    ) -> None:
        self._manifests = {manifest.name: manifest for manifest in manifests}
        self._refused = dict(refused or {})
        self._makers = {kind: maker for kind, maker in makers.items() if kind in EXECUTABLE}
        self._body = body
        for manifest in self._manifests.values():
            if manifest.kind in EXECUTABLE and (why := self._misfit(manifest)):
                self._refused.setdefault(manifest.name, why)

    def _misfit(self, manifest: RSkillManifest) -> str:
        """Return why a skill of an executable kind does not fit this robot, or cannot be made
        here.
        """
        if self._body is not None and (why := self._body.misfit(manifest)):
            return why
        maker = self._makers.get(manifest.kind)
        return maker.refuses(manifest) if isinstance(maker, StandIns) else ""

    def find(
        self, rskill_id: str, revision: str = ""
    ) -> tuple[SkillKey, Callable[[], Skill], RSkillManifest]:
        """Return key, maker and manifest of an executable skill.

        Raises UnknownSkill, which lists what there is.
        """
        manifest = self._manifests.get(rskill_id)
        runnable = [manifest.name for manifest in self.executable()]
        if (why := self._refused.get(rskill_id)) is not None:
            raise UnknownSkill(f"{rskill_id} is not offered here: {why}")
        if manifest is None:
            raise UnknownSkill(
                f"no skill {rskill_id!r} is installed", hint=f"choose from {', '.join(runnable)}"
            )
        maker = self._makers.get(manifest.kind)
        if maker is None:
            raise UnknownSkill(
                f"{rskill_id} is a {manifest.kind} and cannot be executed:"
                f" {_why_not(manifest.kind)}",
                hint=f"choose from {', '.join(runnable)}",
            )
        if revision not in ("", manifest.version):
            raise UnknownSkill(f"{rskill_id} is installed as {manifest.version}, not {revision}")
        return SkillKey(manifest.name, manifest.version), lambda: maker(manifest), manifest

    def deadline_s(self, manifest: RSkillManifest, asked_s: float) -> float:
        """Return the seconds a goal may take from its acceptance.

        As requested, else the manifest's time of motion plus START_S to get there.
        """
        return asked_s or (manifest.latency_budget.max_execution_s or MOTION_S) + START_S

    def executable(self) -> list[RSkillManifest]:
        """Return the skills that a goal may execute."""
        return [
            manifest
            for manifest in self._manifests.values()
            if manifest.kind in self._makers and manifest.name not in self._refused
        ]

    def summary(self) -> list[str]:
        """Return one line per skill: name, version, license, and whether a goal may execute it."""
        lines = []
        for manifest in self._manifests.values():
            if manifest.name in self._refused:
                continue
            kind = (
                ""
                if manifest.kind in self._makers
                else f", a {manifest.kind}: listed, not executed: {_why_not(manifest.kind)}"
            )
            lines.append(f"{manifest.name} {manifest.version} ({manifest.license}){kind}")
        return lines + [f"{name} is not offered: {why}" for name, why in self._refused.items()]

    def as_wire(self) -> list[Message]:
        """Return all manifests as plain maps, for a reasoner's palette."""
        return [manifest.model_dump(mode="json") for manifest in self._manifests.values()]

    def body_as_wire(self) -> Message | None:
        """Return the robot's body, for the same palette; None where any skill fits."""
        return None if self._body is None else self._body.model_dump(mode="json")


def _why_not(kind: Kind) -> str:
    return NOT_EXECUTED.get(kind) or UNMADE[kind]


def sidecar_endpoint(rskill_id: str, given: Mapping[str, str], environ: Mapping[str, str]) -> str:
    """Return the address of a policy's sidecar: as given, else by its name."""
    return given.get(rskill_id) or program_endpoint(sidecar_name(rskill_id), environ, os.getuid())
