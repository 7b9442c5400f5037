"""Both language-model planners against a local server that speaks their wire, or nonsense: real
HTTP.
"""

import asyncio
import json
import logging
from typing import Any

import pytest

from tests.support.llm_apis import KEY, PALETTE, SCHEMA, Anthropic
from vram_arbiter.reasoner.llm.anthropic import AnthropicPlanner
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.planner import Episode, Finish, Note, Outcome, Step
from vram_arbiter.schemas.errors import ConfigError, LlmError
from vram_arbiter.schemas.tools import ExecuteRskill, LocateInView, QueryScene, StopGoal, WaitOn

pytestmark = pytest.mark.anyio

pytest.importorskip("httpx", reason="needs the reasoner extra")


async def at_once(seconds: float) -> None:
    pass


def test_a_call_is_decoded_and_only_what_may_be_used_is_offered(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(("locate_in_view", '{"query": "red cube", "rationale": "look first"}')))
    assert decide() == LocateInView(query="red cube", rationale="look first")
    assert stand_in.paths == [api.path]
    offered = api.offered(stand_in.asked[0])
    assert set(offered) == {
        "execute_rskill__lab__navigate",
        "execute_rskill__lab__grab",
        "locate_in_view",
        "query_scene",
        "finish",
    }
    navigate = offered["execute_rskill__lab__navigate"]["properties"]
    assert navigate["goal_params"] == SCHEMA
    assert "rskill_id" not in navigate
    assert "goal_params" not in offered["execute_rskill__lab__grab"]["properties"]
    assert api.told(stand_in.asked[0]) == ["grab the red cube"]


def test_a_skill_is_called_by_its_own_function(api: Any, stand_in: Any, decide: Any) -> None:
    stand_in.json(
        api.says(
            ("execute_rskill__lab__navigate", '{"goal_params": {"turn_rad": 0.5}, "deadline_s": 9}')
        )
    )
    assert decide() == ExecuteRskill(
        rskill_id="lab/navigate", goal_params_json='{"turn_rad":0.5}', deadline_s=9
    )


def test_parameters_that_do_not_fit_the_skill_are_told_back(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(("execute_rskill__lab__navigate", '{"goal_params": {"turn_rad": 90}}')))
    stand_in.json(
        api.says(("execute_rskill__lab__navigate", '{"goal_params": {"turn_rad": 1.57}}'))
    )
    assert decide().goal_params == {"turn_rad": 1.57}
    assert "goal_params.turn_rad: must be at most 3.2" in api.told(stand_in.asked[1])[-1]


def test_the_episode_is_told_as_a_conversation(api: Any, stand_in: Any, decide: Any) -> None:
    stand_in.json(api.says(("finish", '{"success": true, "reason": "done"}')))
    steps = [
        Step(
            ExecuteRskill(rskill_id="lab/navigate", goal_params_json='{"turn_rad":1}'),
            Outcome("failed", "blocked", data={"at": 1}),
        ),
        Step(LocateInView(query="cube"), Outcome("evicted", "it left", "evicted")),
    ]
    episode = Episode("grab it", steps, [Note("operator", "mind the cat", 1)])
    assert decide(episode) == Finish(True, "done")
    task, call, result, note, look, seen = api.told(stand_in.asked[0])
    assert task == "grab it"
    assert call == 'execute_rskill__lab__navigate {"goal_params":{"turn_rad":1}}'
    assert json.loads(result)["status"] == "failed"
    assert json.loads(result)["data"] == {"at": 1}
    assert note == "operator: mind the cat"
    assert look == 'locate_in_view {"query":"cube"}'
    assert "nothing was looked at" in json.loads(seen)["meaning"]


def test_words_without_a_call_get_one_nudge_and_no_second(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(text="I would look."))
    stand_in.json(api.says(("query_scene", '{"question": "what is there?"}')))
    assert decide() == QueryScene(question="what is there?")
    assert api.told(stand_in.asked[1])[-2:] == [
        "I would look.",
        "Answer with exactly one tool call.",
    ]
    stand_in.json(api.says(text="I would look."))
    stand_in.json(api.says(text=""))
    with pytest.raises(LlmError, match="no tool call"):
        decide()
    assert len(stand_in.asked) == 4


@pytest.mark.parametrize(
    ("calls", "problem"),
    [
        ([("locate_in_view", '{"quary": "red cube"}')], "quary"),
        ([("format_disk", "{}")], "there is no tool"),
        (
            [("locate_in_view", '{"query": "a"}'), ("query_scene", '{"question": "b"}')],
            "2 tool calls at once",
        ),
        ([("locate_in_view", "not json")], "not JSON"),
        ([("execute_rskill__lab__grab", '{"rskill_id": "lab/vlm"}')], "rskill_id"),
        ([("execute_rskill__lab__navigate", '{"goal_params": {"turn_rad": NaN}}')], "NaN"),
        (
            [("execute_rskill__lab__navigate", '{"goal_params": {"turn_rad": 1e999}}')],
            "goal_params",
        ),
        ([("finish", '{"success": "yes", "reason": "x"}')], "success"),
    ],
)
def test_it_gives_up_after_three_unusable_answers(
    api: Any, stand_in: Any, decide: Any, calls: list[tuple[str, str]], problem: str
) -> None:
    for _ in range(3):
        stand_in.json(api.says(*calls))
    with pytest.raises(LlmError):
        decide()
    # a body that is not strict JSON is refused before its calls are read
    if len(stand_in.asked) > 1:
        assert len(stand_in.asked) == 3
        assert problem in " ".join(api.told(stand_in.asked[2]))


@pytest.mark.parametrize("running", [None, ExecuteRskill(rskill_id="lab/grab")])
def test_a_correction_names_what_was_offered_and_nothing_else(
    api: Any, stand_in: Any, decide: Any, running: ExecuteRskill | None
) -> None:
    """Regression: it named every tool that there is, `look` and `wait` among them, and left out
    `finish`: a model that followed it was refused again.
    """
    episode = Episode("grab it", running=running)
    stand_in.json(api.says(("grab", "{}")))
    stand_in.json(api.says(("finish", '{"success": false, "reason": "x"}')))
    decide(episode)
    offered = ", ".join(sorted(api.offered(stand_in.asked[0])))
    said = api.told(stand_in.asked[1])[-1]
    assert f"there is no tool 'grab' (choose from {offered})" in said


def test_a_call_that_has_to_wait_is_told_what_was_offered(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(("execute_rskill__lab__grab", "{}")))
    stand_in.json(api.says(("wait", "{}")))
    decide(Episode("grab it", running=ExecuteRskill(rskill_id="lab/grab")))
    assert "has to wait (choose from finish, stop_goal, wait)" in api.told(stand_in.asked[1])[-1]


def test_while_a_goal_runs_only_its_going_on_is_decided(
    api: Any, stand_in: Any, decide: Any
) -> None:
    running = Episode(
        "grab it",
        notes=[Note("operator", "careful", 0)],
        running=ExecuteRskill(rskill_id="lab/grab"),
    )
    stand_in.json(api.says(("execute_rskill__lab__navigate", "{}")))
    stand_in.json(api.says(("stop_goal", "{}")))
    assert decide(running) == StopGoal()
    assert set(api.offered(stand_in.asked[0])) == {"wait", "stop_goal", "finish"}
    said = api.told(stand_in.asked[0])
    assert "operator: careful" in said
    assert any('"running"' in text for text in said)
    assert "a goal runs" in api.told(stand_in.asked[1])[-1]
    stand_in.json(api.says(("wait", "{}")))
    assert decide(running) == WaitOn()


def test_a_skill_that_cannot_be_started_is_no_longer_offered(
    api: Any, stand_in: Any, decide: Any
) -> None:
    """The defect of the field: a policy whose sidecar does not start was selected for ever."""
    failed = Step(
        ExecuteRskill(rskill_id="lab/grab"), Outcome("failed", "no process", "sidecar_unavailable")
    )
    stand_in.json(api.says(("finish", '{"success": false, "reason": "x"}')))
    decide(Episode("x", [failed, failed, failed]))
    assert "execute_rskill__lab__grab" not in api.offered(stand_in.asked[0])
    assert "execute_rskill__lab__navigate" in api.offered(stand_in.asked[0])


def test_a_perception_model_called_as_a_skill_goes_to_the_loop_to_be_refused(
    api: Any, stand_in: Any, decide: Any
) -> None:
    stand_in.json(api.says(("execute_rskill__lab__vlm", "{}")))
    call = decide()
    refusal = PALETTE.check(call)
    assert refusal.code == "not_permitted"


# -- servers that misbehave
@pytest.mark.parametrize("how", ["hangs", "drips"])
def test_a_server_that_never_ends_its_answer_is_given_up(
    stand_in: Any, decide: Any, how: str
) -> None:
    getattr(stand_in, how)()
    with pytest.raises(LlmError, match=r"within 0\.3 s"):
        decide(timeout_s=0.3)


def test_a_flood_is_cut_off(stand_in: Any, decide: Any) -> None:
    stand_in.floods()
    with pytest.raises(LlmError, match="more than 1048576 bytes"):
        decide()


@pytest.mark.parametrize("status", [302, 400, 401, 404])
def test_a_wrong_request_is_not_repeated_and_the_key_stays_secret(
    stand_in: Any, decide: Any, status: int
) -> None:
    stand_in.body(
        b'{"error": {"message": "no such model"}}', status, {"location": "http://127.0.0.1:1/steal"}
    )
    with pytest.raises(LlmError, match="no such model") as caught:
        decide()
    assert len(stand_in.asked) == 1
    assert KEY not in str(caught.value)
    assert KEY in str(stand_in.headers[0])


@pytest.mark.parametrize(
    "body",
    [
        b"",
        b"<html>",
        b"[]",
        b"3",
        b"{}",
        b'{"choices": []}',
        b'{"choices": [{"message": 3}]}',
        b"[" * 100_000,
        b'{"choices": [{"message": {"tool_calls": [3]}}]}',
        b'{"choices": [{"message": {"tool_calls": {"a": 1}}}]}',
        b'{"type": "error", "error": {}}',
        b'{"type": "message", "role": "user", "content": []}',
        b'{"type": "message", "role": "assistant", "content": [{"type": "tool_use"}]}',
        b'{"type": "message", "role": "assistant", "content": "words"}',
        b"\xff\xfe",
        b'{"choices": NaN}',
    ],
)
def test_garbage_is_a_typed_error(stand_in: Any, decide: Any, body: bytes) -> None:
    stand_in.body(body)
    with pytest.raises(LlmError):
        decide()


def test_nobody_there_is_a_typed_error(api: Any) -> None:
    async def ask() -> None:
        config = LlmConfig("http://127.0.0.1:1", "m")
        async with api.planner(config, PALETTE, pause=at_once) as planner:
            await planner.decide(Episode("x"))

    with pytest.raises(LlmError, match="3 times"):
        asyncio.run(ask())


# -- what only one of the two does
async def test_the_messages_api_gets_what_it_demands(stand_in: Any) -> None:
    stand_in.json(Anthropic.says(("locate_in_view", "{}")))
    stand_in.json(Anthropic.says(("locate_in_view", '{"query": "cube"}')))
    steps = [Step(QueryScene(question="?"), Outcome("answered", "Yes."))]

    async with AnthropicPlanner(LlmConfig(stand_in.url + "/v1", "m", KEY), PALETTE) as planner:
        result = await planner.decide(Episode("x", steps, [Note("operator", "go on", 1)]))
    assert result == LocateInView(query="cube")
    body = stand_in.asked[1]
    assert stand_in.paths[0] == "/v1/messages"
    assert stand_in.headers[0]["x-api-key"] == KEY
    assert stand_in.headers[0]["anthropic-version"] == "2023-06-01"
    assert body["tool_choice"] == {"type": "any", "disable_parallel_tool_use": True}
    assert body["max_tokens"] > 0
    roles = [message["role"] for message in body["messages"]]
    assert roles == ["user", "assistant"] * (len(roles) // 2) + ["user"] * (len(roles) % 2)
    for called, answered in zip(body["messages"][1::2], body["messages"][2::2], strict=True):
        uses = [block["id"] for block in called["content"] if block["type"] == "tool_use"]
        first = answered["content"][0]
        assert [first["tool_use_id"]] == uses
    assert body["messages"][-1]["content"][0]["is_error"] is True


def test_the_environment_is_checked() -> None:
    with pytest.raises(ConfigError, match="VRAM_REASONER_LLM_BASE_URL and VRAM_REASONER_LLM_MODEL"):
        LlmConfig.from_environ({})
    complete = {"VRAM_REASONER_LLM_BASE_URL": "http://x/v1/", "VRAM_REASONER_LLM_MODEL": "m"}
    assert LlmConfig.from_environ(complete).base_url == "http://x/v1"
    for name, text in (
        ("TIMEOUT_S", "soon"),
        ("TIMEOUT_S", "-1"),
        ("TIMEOUT_S", "nan"),
        ("MAX_TOKENS", "0"),
    ):
        with pytest.raises(ConfigError, match="expected a number"):
            LlmConfig.from_environ(complete | {f"VRAM_REASONER_LLM_{name}": text})
    with pytest.raises(ConfigError, match="expected an http"):
        LlmConfig.from_environ(complete | {"VRAM_REASONER_LLM_BASE_URL": "file:///etc/passwd"})
    cloud = LlmConfig.from_environ(
        {"VRAM_REASONER_LLM_MODEL": "m"}, base_url=AnthropicPlanner.default_base_url
    )
    assert cloud.base_url == "https://api.anthropic.com"


def test_a_password_in_the_address_stands_in_no_message(
    api: Any, stand_in: Any, caplog: pytest.LogCaptureFixture
) -> None:
    """Regression: each request was a line of httpx's in the log of a reasoner at its usual level,
    with the whole address.
    """
    address = stand_in.url.replace("http://", "http://me:secret@") + api.base
    caplog.set_level(logging.DEBUG)

    async def once(config: LlmConfig) -> None:
        async with api.planner(config, PALETTE, pause=at_once) as planner:
            await planner.decide(Episode("grab the red cube"))

    stand_in.json({"not": "an answer"})
    with pytest.raises(LlmError) as wrong:
        asyncio.run(once(LlmConfig(address, "m", KEY)))
    with pytest.raises(LlmError) as gone:
        asyncio.run(once(LlmConfig("http://me:secret@127.0.0.1:9" + api.base, "m", KEY)))
    for text in (str(wrong.value), str(gone.value), caplog.text):
        assert "127.0.0.1" in text
        assert "secret" not in text


def test_a_key_that_no_header_carries_is_refused_and_not_shown() -> None:
    """Regression: a key with an odd byte stood in the log, or ended the reasoner with a traceback;
    so did an address that is none.
    """
    complete = {"VRAM_REASONER_LLM_BASE_URL": "http://x/v1/", "VRAM_REASONER_LLM_MODEL": "m"}
    for key in ("secret\nkey", "sécret", "secret\x00", "secret\udcff", "my secret\rkey"):
        with pytest.raises(ConfigError, match="VRAM_REASONER_LLM_API_KEY") as caught:
            LlmConfig.from_environ(complete | {"VRAM_REASONER_LLM_API_KEY": key})
        assert "ecret" not in str(caught.value)
    as_read_from_a_file = complete | {"VRAM_REASONER_LLM_API_KEY": " secret\n"}
    assert LlmConfig.from_environ(as_read_from_a_file).api_key == "secret"
    for url in (
        "htps://me:secret@host",
        "http://me:secret@[bad",
        "http://me:secret@host:99999",
        "http://",
        "http:///v1",
    ):
        with pytest.raises(
            ConfigError, match="VRAM_REASONER_LLM_BASE_URL: expected an http"
        ) as caught:
            LlmConfig.from_environ(complete | {"VRAM_REASONER_LLM_BASE_URL": url})
        assert "secret" not in str(caught.value)
    with pytest.raises(ConfigError, match="MAX_TOKENS: expected a number"):
        LlmConfig.from_environ(complete | {"VRAM_REASONER_LLM_MAX_TOKENS": "0.5"})
