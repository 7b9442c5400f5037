"""What continuous detectors see, from the runner's world state to the planner's words: with its
age, and never what is too old.
"""

import json
from typing import Any

import pytest

from tests.support.llm_apis import PALETTE
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.reasoner.cascade import Words, conversation
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome, Seen, Sight
from vram_arbiter.reasoner.sight import look_at, sight_of
from vram_arbiter.runner.sensors.detections import DetectionSlot
from vram_arbiter.runner.sensors.world_state import WorldStateAggregator
from vram_arbiter.schemas.tools import Look, ToolCall
from vram_arbiter.schemas.world import DetectedObject, JointState, WorldState

pytestmark = pytest.mark.anyio

MS = 1_000_000
START_NS = 10_000 * MS
CUBE = DetectedObject(
    label="red cube", confidence=0.875, box=(0, 0, 5, 5), sensor_id="front", stamp_ns=START_NS
)


def world_after(age_ms: int, *slots: DetectionSlot) -> WorldState:
    now_ns = START_NS + age_ms * MS
    aggregator = WorldStateAggregator({}, detections=slots)
    joints = JointState(name=("a",), position=(0.5,), stamp_ns=now_ns)
    aggregator.update_joint_state(joints, now_ns)
    return aggregator.snapshot(now_ns)


@pytest.fixture
def slots() -> tuple[DetectionSlot, DetectionSlot]:
    """The front camera's detector has looked, the rear one's was evicted."""
    front, rear = DetectionSlot("front", 1000.0), DetectionSlot("rear", 1000.0)
    front.put([CUBE], START_NS, START_NS)
    rear.put([CUBE], START_NS, START_NS)
    rear.lose("its model was evicted")
    return front, rear


def test_the_age_counts_from_the_picture_and_what_is_beyond_the_bound_is_not_there(
    slots: Any,
) -> None:
    seen = Seen("red cube", 0.875, "front", pytest.approx(0.9))
    assert sight_of(world_after(900, *slots)) == Sight((seen,), ("rear",))
    assert sight_of(world_after(1001, *slots)) == Sight((), ("front", "rear"))
    assert sight_of(world_after(0)) is None, "no detector looks all the time"


def test_detections_of_a_runner_whose_loop_hangs_are_not_there(slots: Any) -> None:
    """It serves its last world state, with everything in it marked as stale."""
    world = world_after(0, *slots)
    stale = dict.fromkeys(world.diagnostics, "stale")
    assert sight_of(world.model_copy(update={"diagnostics": stale})) == Sight((), ("front", "rear"))


async def test_it_is_read_from_the_runners_state(
    runner: Any, client: RunnerClient, slots: Any
) -> None:
    runner.world = world_after(400, *slots).model_dump(mode="json", exclude={"image_frames"})
    seen = Seen("red cube", 0.875, "front", pytest.approx(0.4))
    assert await look_at(client) == Sight((seen,), ("rear",))
    runner.world = {"stamp_ns": "yesterday"}
    assert await look_at(client) is None


def words_of(sight: Sight | None) -> list[dict[str, Any]]:
    turns = conversation(Episode("grab it", sight=sight), PALETTE)
    texts = [turn.text for turn in turns if isinstance(turn, Words)]
    return [json.loads(text.partition(": ")[2]) for text in texts if "world state" in text]


def test_a_language_model_is_told_what_is_seen_now() -> None:
    (told,) = words_of(Sight((Seen("red\ncube", 0.876, "front", 0.44),), ("rear",)))
    about = {"label": "red cube", "camera": "front", "confidence": 0.88, "age_s": 0.4}
    assert told["detected_objects"] == [about]
    assert told["not_looking"] == ["rear"]
    assert "says nothing about the scene" in told["meaning_of_not_looking"]
    (nothing,) = words_of(Sight(()))
    assert nothing["detected_objects"] == []
    assert "not_looking" not in nothing
    assert words_of(None) == []


async def test_each_question_to_the_planner_has_what_is_seen_then() -> None:
    sights = iter([Sight(()), Sight((Seen("red cube", 0.9, "front", 0.1),))])
    asked: list[Sight | None] = []

    class Looking:
        async def decide(self, episode: Episode) -> ToolCall | Finish:
            asked.append(episode.sight)
            return Finish(True, "seen") if episode.sight and episode.sight.seen else Look()

    async def next_sight() -> Sight:
        return next(sights)

    async def dispatch(call: ToolCall) -> Outcome:
        return Outcome("shown", "")

    result = await run_episode("look", Looking(), PALETTE, dispatch, look_at=next_sight)
    assert result["status"] == "success"
    assert [len(sight.seen) for sight in asked if sight] == [0, 1]
