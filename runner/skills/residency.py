"""Residency: one GPU-holding skill at a time, by (rskill_id, revision); the prompt does not matter.

The same key is reused (and reset by its `start`), another key displaces the old skill first.
GPU-free skills are independent: they take no slot and displace no skill. Holds no lock over a goal:
callers run one goal at a time.
"""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable

from vram_arbiter.runner.protocols import Goal, Skill, SkillKey
from vram_arbiter.schemas.errors import VramError

log = logging.getLogger(__name__)

EVICT_S = 30.0  # a skill that needs longer to leave is abandoned: the arbiter measures what is free
CLOSE_S = 3.0  # the runner ends: its sidecar may be ending too


class Residency:
    """`acquire(key, make)` returns the resident skill of a key, made if need be; `start` begins a
    goal.
    """

    def __init__(self) -> None:
        self._lock = asyncio.Lock()
        self._resident: Skill | None = None
        self._served: Skill | None = None  # the one that was started for a goal at least once
        self._free: dict[SkillKey, Skill] = {}

    @property
    def resident(self) -> SkillKey | None:
        """Key of the GPU-holding skill, if any."""
        return self._resident.key if self._resident is not None else None

    async def acquire(self, key: SkillKey, make: Callable[[], Skill]) -> Skill:
        """Reuse or make a skill. Raises what `make` raises; then the slot is as empty as before."""
        async with self._lock:
            if key in self._free:
                return self._free[key]
            if self._resident is not None and self._resident.key == key:
                return self._resident
            skill = make()
            if not skill.holds_gpu:
                self._free[key] = skill
                return skill
            await self._evict(EVICT_S)
            self._resident = skill
            return skill

    async def start(self, skill: Skill, goal: Goal) -> None:
        """Start it for a goal. Raises what the start raises.

        A skill that fails its very first start (its model does not load) leaves nothing behind; one
        that has served stays, and its next start loads again what is missing.
        """
        try:
            await skill.start(goal)
        except BaseException:
            if skill is self._resident and skill is not self._served:
                self._resident = None
                await _release(skill, CLOSE_S)
            raise
        self._served = skill if skill is self._resident else self._served

    async def _evict(self, timeout_s: float) -> None:
        if (leaving := self._resident) is not None:
            self._resident = None
            await _release(leaving, timeout_s)

    async def close(self) -> None:
        """Release everything."""
        async with self._lock:
            await self._evict(CLOSE_S)
            for skill in self._free.values():
                await _release(skill, CLOSE_S)
            self._free.clear()


async def _release(skill: Skill, timeout_s: float) -> None:
    try:
        async with asyncio.timeout(timeout_s):
            await skill.release()
    except (VramError, TimeoutError) as error:  # its process may be gone
        log.warning(
            "%s did not release cleanly: %s",
            skill.key,
            str(error) or f"not within {timeout_s:.0f} s",
        )
