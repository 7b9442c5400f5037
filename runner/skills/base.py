"""Life cycle of a skill; concrete skills fill in the hooks.

A skill is started for a goal, stepped by the control thread, finished (also after a failed start),
started again for the next goal of the same key, and released once. Any other order raises with the
present state.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from enum import StrEnum

from vram_arbiter.runner.protocols import Goal, SkillKey, StepOutcome
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import WorldState


class SkillState(StrEnum):
    IDLE = "idle"
    STARTING = "starting"
    ACTIVE = "active"
    RELEASED = "released"


_ALLOWED = {
    SkillState.STARTING: {SkillState.IDLE},
    SkillState.ACTIVE: {SkillState.STARTING},
    SkillState.IDLE: {SkillState.STARTING, SkillState.ACTIVE, SkillState.IDLE},
    SkillState.RELEASED: {SkillState.IDLE},
}


class SkillBase(ABC):
    """Hooks: `_start` (reset included), `_step`, `_finish`, `_release`.

    `fraction`: share done, 0 to 1.
    """

    holds_gpu = False

    def __init__(self, manifest: RSkillManifest, *, revision: str = "") -> None:
        self.manifest = manifest
        self.key = SkillKey(manifest.name, revision or manifest.version)
        self.cameras: tuple[str, ...] = ()
        self.fraction = 0.0
        self.phase = ""
        self.state = SkillState.IDLE

    def _move(self, to: SkillState) -> None:
        if self.state not in _ALLOWED[to]:
            raise BadState(f"{self.key} is {self.state} and cannot become {to}")
        self.state = to

    async def start(self, goal: Goal) -> None:
        """Make it ready to be stepped, reset in any case.

        Raises typed errors; then it is idle again.
        """
        self._move(SkillState.STARTING)
        self.fraction = 0.0
        self.phase = ""
        try:
            await self._start(goal)
        except BaseException:
            try:
                await self._finish()
            finally:
                self._move(SkillState.IDLE)  # else it could never be started again
            raise
        self._move(SkillState.ACTIVE)

    def step(self, world: WorldState) -> StepOutcome:
        """Control thread: what to do now. Raises a VramError to fail the goal."""
        if self.state is not SkillState.ACTIVE:
            raise BadState(f"{self.key} is {self.state}, not active")
        return self._step(world)

    async def finish(self) -> None:
        """End the goal, however it went. Repeatable."""
        if self.state is SkillState.ACTIVE:
            try:
                await self._finish()
            finally:
                self._move(SkillState.IDLE)

    async def release(self) -> None:
        """Free everything for good. Repeatable."""
        if self.state is not SkillState.RELEASED:
            await self.finish()
            self._move(SkillState.RELEASED)
            await self._release()

    def wants_frames(self) -> bool:
        """Control thread: whether the next step wants to see the cameras."""
        return False

    @abstractmethod
    async def _start(self, goal: Goal) -> None: ...

    @abstractmethod
    def _step(self, world: WorldState) -> StepOutcome: ...

    async def _finish(self) -> None:  # noqa: B027 — most skills leave nothing behind
        """End what `_start` began."""

    async def _release(self) -> None:  # noqa: B027 — as above
        """Free what outlives goals."""
