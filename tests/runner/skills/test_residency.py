"""One GPU-holding skill is resident by (rskill_id, revision); GPU-free ones come and go beside
it.
"""

import asyncio
from collections.abc import Callable
from pathlib import Path

import pytest

from vram_arbiter.runner.protocols import Done, Goal, SkillKey, StepOutcome
from vram_arbiter.runner.skills import residency as residency_module
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.residency import Residency
from vram_arbiter.schemas.errors import BadState, ManifestInvalid, SidecarUnavailable
from vram_arbiter.schemas.manifest import RSkillManifest, load_manifest
from vram_arbiter.schemas.world import WorldState

pytestmark = pytest.mark.anyio

GOAL = Goal("g", "r", prompt="now")


class Recording(SkillBase):
    def __init__(
        self, manifest: RSkillManifest, revision: str, holds_gpu: bool, fails: str = ""
    ) -> None:
        super().__init__(manifest, revision=revision)
        self.holds_gpu = holds_gpu
        self.fails = fails
        self.story: list[str] = []
        self.starting = asyncio.Event()

    async def _start(self, goal: Goal) -> None:
        self.story.append(f"start {goal.prompt}")
        self.starting.set()
        if self.fails == "cancel":
            await asyncio.Event().wait()
        if self.fails == "start":
            raise SidecarUnavailable("no")

    def _step(self, world: WorldState) -> StepOutcome:
        return Done()

    async def _finish(self) -> None:
        self.story.append("finish")

    async def _release(self) -> None:
        self.story.append("release")
        if self.fails == "hang":
            await asyncio.Event().wait()
        if self.fails == "release":
            raise SidecarUnavailable("gone")


@pytest.fixture
def make_skill(navigate_manifest: Path) -> Callable[..., Recording]:
    manifest = load_manifest(navigate_manifest)

    def make(revision: str = "1", holds_gpu: bool = True, fails: str = "") -> Recording:
        return Recording(manifest, revision, holds_gpu, fails)

    return make


async def test_the_same_key_is_reused_whatever_the_prompt(
    make_skill: Callable[..., Recording],
) -> None:
    residency, made = Residency(), make_skill()
    for prompt in ("red", "blue"):
        got = await residency.acquire(made.key, lambda: made)
        await got.start(Goal("g", "r", prompt=prompt))
        await got.finish()
    assert made.story == ["start red", "finish", "start blue", "finish"]


@pytest.mark.parametrize("fails", ["", "release"])
async def test_another_key_makes_the_old_one_leave_first(
    make_skill: Callable[..., Recording], fails: str
) -> None:
    residency, old, new = Residency(), make_skill("1", fails=fails), make_skill("2")
    await residency.acquire(old.key, lambda: old)
    assert await residency.acquire(new.key, lambda: new) is new
    assert old.story == ["release"]
    assert residency.resident == new.key
    await residency.close()
    assert new.story == ["release"]
    assert residency.resident is None


async def test_a_gpu_free_skill_makes_nobody_leave(make_skill: Callable[..., Recording]) -> None:
    residency, policy, drive = Residency(), make_skill("1"), make_skill("drive", holds_gpu=False)
    await residency.acquire(policy.key, lambda: policy)
    assert await residency.acquire(drive.key, lambda: drive) is drive
    assert await residency.acquire(drive.key, lambda: make_skill()) is drive
    assert policy.story == []
    assert residency.resident == policy.key


async def test_a_skill_that_cannot_be_made_leaves_the_resident_one_alone(
    make_skill: Callable[..., Recording],
) -> None:
    def broken() -> Recording:
        raise ManifestInvalid("no")

    residency, old = Residency(), make_skill("1")
    await residency.acquire(old.key, lambda: old)
    with pytest.raises(ManifestInvalid):
        await residency.acquire(SkillKey("x"), broken)
    assert residency.resident == old.key
    assert old.story == []


async def test_a_failed_start_is_cleaned_up_and_can_be_tried_again(
    make_skill: Callable[..., Recording],
) -> None:
    made = make_skill(fails="start")
    with pytest.raises(SidecarUnavailable):
        await made.start(Goal("g", "r"))
    assert made.story == ["start ", "finish"]
    made.fails = ""
    await made.start(Goal("g", "r"))
    assert made.state == "active"


async def test_steps_out_of_order_are_refused(make_skill: Callable[..., Recording]) -> None:
    made = make_skill()
    with pytest.raises(BadState, match="idle, not active"):
        made.step(None)  # type: ignore[arg-type]  # refused before it is looked at
    await made.start(Goal("g", "r"))
    with pytest.raises(BadState):
        await made.start(Goal("g", "r"))
    await made.release()
    await made.release()
    assert made.story.count("release") == 1
    with pytest.raises(BadState, match="released"):
        await made.start(Goal("g", "r"))


async def test_a_skill_that_does_not_let_go_holds_nobody_up(
    make_skill: Callable[..., Recording], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(residency_module, "EVICT_S", 0.05)

    residency, old, new = Residency(), make_skill("1", fails="hang"), make_skill("2")
    await residency.acquire(old.key, lambda: old)
    assert await residency.acquire(new.key, lambda: new) is new
    assert residency.resident == new.key


async def test_another_revision_of_the_same_skill_is_another_key(
    make_skill: Callable[..., Recording],
) -> None:
    residency, old, new = Residency(), make_skill("1"), make_skill("2")
    assert old.key.rskill_id == new.key.rskill_id
    assert await residency.acquire(old.key, lambda: old) is old
    assert await residency.acquire(new.key, lambda: new) is new
    assert (old.story, residency.resident) == (["release"], new.key)


@pytest.mark.parametrize("fails", ["start", "cancel"])
async def test_a_first_start_that_fails_leaves_nothing_behind(
    make_skill: Callable[..., Recording], fails: str
) -> None:
    """Regression: the runner called a skill resident whose model had never come up."""

    residency, old, new = Residency(), make_skill("1"), make_skill("2", fails=fails)
    await residency.start(await residency.acquire(old.key, lambda: old), GOAL)
    await old.finish()
    await residency.acquire(new.key, lambda: new)
    starting = asyncio.create_task(residency.start(new, GOAL))
    if fails == "cancel":
        await new.starting.wait()
        starting.cancel()
    with pytest.raises((SidecarUnavailable, asyncio.CancelledError)):
        await starting
    assert new.story == ["start now", "finish", "release"]
    assert residency.resident is None
    assert old.story[-1] == "release", (
        "it has left already, and comes back by the next goal that wants it"
    )
    again = make_skill("1")
    assert await residency.acquire(again.key, lambda: again) is again


async def test_a_skill_that_has_served_stays_when_a_later_start_fails(
    make_skill: Callable[..., Recording],
) -> None:
    residency, made = Residency(), make_skill()
    await residency.acquire(made.key, lambda: made)
    await residency.start(made, GOAL)
    await made.finish()
    made.fails = "start"
    with pytest.raises(SidecarUnavailable):
        await residency.start(made, GOAL)
    assert residency.resident == made.key
    assert "release" not in made.story
    made.fails = ""
    await residency.start(made, GOAL)
    assert made.state == "active"


async def test_a_failing_gpu_free_skill_leaves_the_resident_one_alone(
    make_skill: Callable[..., Recording],
) -> None:
    residency, policy, drive = (
        Residency(),
        make_skill("1"),
        make_skill("drive", holds_gpu=False, fails="start"),
    )
    await residency.acquire(policy.key, lambda: policy)
    await residency.acquire(drive.key, lambda: drive)
    with pytest.raises(SidecarUnavailable):
        await residency.start(drive, GOAL)
    assert residency.resident == policy.key
    assert "release" not in policy.story + drive.story
