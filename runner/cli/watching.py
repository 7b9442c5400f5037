"""Continuous detectors of a deployment: which of the installed skills they are, and their tasks."""

from __future__ import annotations

import asyncio
import contextlib
from collections.abc import AsyncIterator, Iterable, Mapping, Sequence
from dataclasses import dataclass

from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.runner.cli.deployment import DeploymentFile
from vram_arbiter.runner.control.clock import Clock
from vram_arbiter.runner.goals.catalogue import sidecar_endpoint
from vram_arbiter.runner.robots.hardware import HardwareRobot
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.detector import ContinuousDetector
from vram_arbiter.schemas.config.robot import DetectorConfig
from vram_arbiter.schemas.manifest import Kind, RSkillManifest
from vram_arbiter.schemas.manifest.contracts import DetectorContract
from vram_arbiter.schemas.manifest.vocabulary import DetectorMode


@dataclass(frozen=True, slots=True)
class Watch:
    """One continuous detector: its configuration, its manifest's labels, its sidecar."""

    config: DetectorConfig
    labels: tuple[str, ...]
    endpoint: str

    @property
    def line(self) -> tuple[str, str]:
        """One line of the dry run."""
        config = self.config
        text = (
            f"{config.id} at {self.endpoint} looks at {config.sensor_id}, at most"
            f" {config.rate_hz:g} times a second; at most {config.max_age_ms:g} ms old"
        )
        return "detector", text


def watches(
    file: DeploymentFile,
    manifests: Iterable[RSkillManifest],
    given: Mapping[str, str],
    environ: Mapping[str, str],
) -> tuple[Watch, ...]:
    """Return the file's continuous detectors.

    Raises ConfigError with every entry that is not an installed detector, or not continuous.
    """
    installed = {
        manifest.name: manifest.detector
        for manifest in manifests
        if manifest.kind is Kind.DETECTOR and manifest.detector is not None
    }
    found: list[Watch] = []
    problems: list[tuple[str, str]] = []
    for index, config in enumerate(file.robot.detectors):
        contract = installed.get(config.id)
        if contract is None:
            known = ", ".join(installed) or "none"
            problem = f"no such detector is installed: {config.id}; there is {known}"
            problems.append((f"detectors[{index}].id", problem))
        elif problem := _not_continuous(config, contract):
            problems.append((f"detectors[{index}].mode", problem))
        else:
            endpoint = sidecar_endpoint(config.id, given, environ)
            found.append(Watch(config, contract.labels, endpoint))
    if problems:
        raise file.error(*problems)
    return tuple(found)


def _not_continuous(config: DetectorConfig, contract: DetectorContract) -> str:
    if (config.mode or contract.mode) is DetectorMode.CONTINUOUS:
        return ""
    if config.mode is None:
        return f"{config.id} is on_demand by its manifest: write `mode: continuous`"
    return "a detector that is asked on demand needs no entry here: leave it out"


def slots_of(found: Sequence[Watch]) -> tuple[DetectionSlot, ...]:
    """Return an empty slot for each detector."""
    return tuple(DetectionSlot(one.config.sensor_id, one.config.max_age_ms) for one in found)


@contextlib.asynccontextmanager
async def watching(
    found: Sequence[Watch], robot: HardwareRobot, clock: Clock
) -> AsyncIterator[None]:
    """While inside, the detectors look. The robot's cameras have to be open."""
    async with contextlib.AsyncExitStack() as stack:
        tasks = []
        for one, slot in zip(found, robot.detections, strict=True):
            client = await stack.enter_async_context(DetectorClient(one.endpoint))
            detector = ContinuousDetector(
                one.config, one.labels, client, robot.snapshot, slot, clock
            )
            tasks.append(asyncio.create_task(detector.run(), name=slot.name))
        try:
            yield
        finally:
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)
