"""What both APIs are told of this robot, and what is written down of their answers."""

import base64
import dataclasses
import json
from pathlib import Path
from typing import Any

import pytest

from tests.support.llm_apis import KEY, PALETTE, OpenAi
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.llm.openai import OpenAiPlanner
from vram_arbiter.reasoner.llm.prompt import instructions
from vram_arbiter.reasoner.llm.transcript import Transcript
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Outcome, Step
from vram_arbiter.schemas.body import Body
from vram_arbiter.schemas.errors import LlmError
from vram_arbiter.schemas.reasoner import TranscriptLine
from vram_arbiter.schemas.tools import ExecuteRskill, Look, QueryScene, ToolCall

pytestmark = pytest.mark.anyio

pytest.importorskip("httpx", reason="needs the reasoner extra")

LOOK = ("look", '{"camera": "wrist"}')
SEEING = dataclasses.replace(PALETTE, can_look=True, cameras=("front", "wrist"))
PICTURE = b"\xff\xd8 a picture of the gripper" * 64


def test_current_parameters(api: Any, stand_in: Any, decide: Any) -> None:
    """Models that think first refuse `max_tokens` and any temperature but their own."""
    stand_in.json(api.says(("query_scene", '{"question": "?"}')))
    decide()
    (body,) = stand_in.asked
    assert "temperature" not in body
    if api is OpenAi:
        assert body["max_completion_tokens"] == 4096
        assert body["parallel_tool_calls"] is False
        assert "max_tokens" not in body
    else:
        assert body["max_tokens"] == 4096
        assert body["tool_choice"]["disable_parallel_tool_use"] is True


async def test_a_parameter_that_a_model_refuses_is_left_out_from_then_on(stand_in: Any) -> None:
    """o1, o3 and o4-mini refuse `parallel_tool_calls`, which other models have to be told."""
    for name in ("parallel_tool_calls", "max_completion_tokens"):
        text = f"Unsupported parameter: '{name}' is not supported with this model."
        stand_in.json({"error": {"message": text}}, 400)
    for _ in range(2):
        stand_in.json(OpenAi.says(("query_scene", '{"question": "?"}')))
    stand_in.json({"error": {"message": "Unsupported parameter: 'tools'"}}, 400)

    async with OpenAiPlanner(LlmConfig(stand_in.url, "m", KEY), PALETTE) as planner:
        for _ in range(2):
            await planner.decide(Episode("x"))
        with pytest.raises(LlmError, match="'tools'"):
            await planner.decide(Episode("x"))
    assert len(stand_in.asked) == 5
    assert "parallel_tool_calls" not in stand_in.asked[1]
    for body in stand_in.asked[2:]:
        assert "parallel_tool_calls" not in body
        assert "max_completion_tokens" not in body
        assert body["max_tokens"] == 4096


def test_cameras_are_a_choice_and_another_one_is_told_back(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(("query_scene", '{"question": "?", "camera": "rear"}')))
    stand_in.json(api.says(("query_scene", '{"question": "?", "camera": "wrist"}')))
    assert decide(palette=SEEING) == QueryScene(question="?", camera="wrist")
    offered = api.offered(stand_in.asked[0])
    for name in ("locate_in_view", "query_scene", "look"):
        assert offered[name]["properties"]["camera"]["enum"] == ["front", "wrist"]
    assert "prompt" in offered["execute_rskill__lab__grab"]["properties"]
    assert "prompt" not in offered["execute_rskill__lab__navigate"]["properties"]
    assert set(offered["locate_in_view"]["properties"]) == {"query", "camera", "rationale"}
    assert "unknown camera rear" in api.told(stand_in.asked[1])[-1]


def test_a_picture_is_shown_and_the_oldest_is_shown_no_more(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(LOOK))
    shown = [
        Step(Look(camera="wrist"), Outcome("shown", "wrist", picture=PICTURE + str(n).encode()))
        for n in range(3)
    ]
    assert decide(Episode("x", shown), palette=SEEING) == Look(camera="wrist")
    (body,) = stand_in.asked
    decoded = [base64.b64decode(text) for text in api.pictures(body)]
    assert decoded == [step.outcome.picture for step in shown[1:]]
    results = [json.loads(text) for text in api.told(body) if text.startswith("{")]
    assert "not shown any more" in results[0]["meaning"]
    assert "is attached" in results[1]["meaning"]


def test_a_policy_that_ran_is_not_called_a_success(api: Any, stand_in: Any, decide: Any) -> None:
    stand_in.json(api.says(("finish", '{"success": false, "reason": "x"}')))
    ran = [
        Step(ExecuteRskill(rskill_id=name), Outcome("succeeded", ""))
        for name in ("lab/grab", "lab/navigate")
    ]
    decide(Episode("x", ran))
    grabbed, drove = (
        json.loads(text) for text in api.told(stand_in.asked[0]) if text.startswith('{"status')
    )
    assert "not judged" in grabbed["meaning"]
    assert drove["meaning"] == "the goal was reached"


def test_an_answer_without_its_end_says_what_to_raise(api: Any, stand_in: Any, decide: Any) -> None:
    stand_in.json(api.is_cut_off("Let me think about this cube"))
    with pytest.raises(LlmError, match=r"cut off after 4096 tokens.*LLM_MAX_TOKENS"):
        decide()


async def test_tokens_and_rejected_answers_are_written_down(
    api: Any, stand_in: Any, tmp_path: Path
) -> None:
    stand_in.json(api.says(("locate_in_view", "{}")))
    stand_in.json({"error": {"message": "no such model"}}, 404)
    file = tmp_path / "transcript.jsonl"
    seen = Step(Look(), Outcome("shown", "front", picture=PICTURE))

    config = LlmConfig(stand_in.url + api.base, "m", KEY)
    transcript = Transcript(file)
    async with api.planner(config, SEEING, transcript=transcript) as planner:
        with pytest.raises(LlmError):
            await planner.decide(Episode("find it", [seen]))
        transcript.close()
        result = planner.tally.as_result("m")
    assert result == {
        "model": "m",
        "requests": 2,
        "failed": 1,
        "rejected": 1,
        "input_tokens": 1200,
        "output_tokens": 34,
    }
    text = file.read_text()
    assert KEY not in text
    assert base64.b64encode(PICTURE).decode()[:40] not in text
    lines = [TranscriptLine.model_validate_json(line) for line in text.splitlines()]
    assert [line.kind for line in lines] == ["answered", "rejected", "failed"]
    assert isinstance(lines[0].request, dict)
    assert "find it" in json.dumps(lines[0].request)
    assert "characters of a picture" in json.dumps(lines[0].request)
    assert "query" in (lines[1].problem or "")
    assert "no such model" in (lines[2].problem or "")


def test_only_what_is_there_is_named_in_the_instructions() -> None:
    target = {"type": "object", "properties": {"target_point": {"type": "object"}}}
    go = Skill("lab/go", "ros_action", "drive", ("navigate",), target)
    full = Palette(
        (go, Skill("lab/grab", "vla", "grab", ("grasp",))),
        cameras=("front", "wrist"),
        body=Body(embodiment_tags=("so101_follower",), capabilities={"payload_kg": 0.3}),
    )
    said = instructions(full, "Turn left first.")
    assert "so101_follower" in said
    assert "payload_kg: 0.3" in said
    assert "front (the default), wrist" in said
    assert "execute_rskill__lab__go" in said
    assert 'query_scene, camera "wrist"' in said
    assert said.endswith("Turn left first.")
    bare = instructions(Palette((), can_locate=False, can_query=False))
    for name in ("execute_rskill__", "locate_in_view", "query_scene", "look,", "camera"):
        assert name not in bare
    assert "Nothing here moves the robot" in bare


async def test_the_next_skill_is_a_choice_and_another_one_is_ignored_with_a_note(
    api: Any, stand_in: Any
) -> None:
    """A hint is not worth a refused motion: the drive begins without it."""
    drive = "execute_rskill__lab__navigate"
    stand_in.json(api.says((drive, '{"next_rskill_id": "lab/grab"}')))
    stand_in.json(api.says((drive, '{"next_rskill_id": "lab/arm"}')))
    stand_in.json(api.says(("finish", '{"success": true, "reason": "done"}')))
    called: list[ToolCall] = []

    async def driven(call: ToolCall) -> Outcome:
        called.append(call)
        return Outcome("succeeded", "there")

    config = LlmConfig(stand_in.url + api.base, "m", KEY)
    async with api.planner(config, PALETTE) as planner:
        result = await run_episode("grab the red cube", planner, PALETTE, driven)
    go = ExecuteRskill(rskill_id="lab/navigate")
    assert called == [go.model_copy(update={"next_rskill_id": "lab/grab"}), go]
    offered = api.offered(stand_in.asked[0])
    assert offered[drive]["properties"]["next_rskill_id"]["enum"] == ["lab/grab"]
    assert "next_rskill_id" not in offered["execute_rskill__lab__grab"]["properties"]
    assert "name it as next_rskill_id" in api.system(stand_in.asked[0])
    note = "next_rskill_id 'lab/arm' was ignored: choose from lab/grab"
    assert result["notes"] == [{"source": "reasoner", "text": note, "after": 1}]
    assert f"reasoner: {note}" in api.told(stand_in.asked[2])
