"""The OpenAI-compatible planner against a local stand-in server: real HTTP, scripted answers."""

import asyncio
import json
import threading
from collections.abc import Iterator
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any

import pytest

from reasoner.llm.openai import LlmConfig, OpenAiPlanner
from reasoner.palette import Palette, Skill
from reasoner.planner import Episode, Finish, Outcome, Step
from schemas.errors import ConfigError, LlmError
from schemas.tools import ExecuteRskill, LocateInView

pytest.importorskip("httpx", reason="needs the reasoner extra")

PALETTE = Palette(
    (Skill("lab/navigate", "ros_action", "drive", ("navigate",)), Skill("lab/vlm", "vlm", "look", ("query",)))
)


class StandIn:
    """Answers each request with the next scripted body, and remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[dict[str, Any]] = []
        self.answers: list[tuple[int, bytes]] = []
        self.release = threading.Event()
        stand_in = self

        class Handler(BaseHTTPRequestHandler):
            def do_POST(self) -> None:
                stand_in.asked.append(json.loads(self.rfile.read(int(self.headers["Content-Length"]))))
                status, body = stand_in.answers.pop(0)
                if status == 0:  # never answers while the test lasts
                    stand_in.release.wait(30)
                    return
                self.send_response(status)
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, format: str, *args: Any) -> None:
                pass

        self.server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self.url = f"http://127.0.0.1:{self.server.server_port}/v1"

    def says(self, message: dict[str, Any]) -> None:
        self.answers.append((200, json.dumps({"choices": [{"message": message}]}).encode()))

    def calls(self, name: str, arguments: str) -> None:
        self.says(
            {
                "role": "assistant",
                "content": None,
                "tool_calls": [{"id": "a", "function": {"name": name, "arguments": arguments}}],
            }
        )


@pytest.fixture
def stand_in() -> Iterator[StandIn]:
    server = StandIn()
    thread = threading.Thread(target=server.server.serve_forever)
    thread.start()
    yield server
    server.release.set()
    server.server.shutdown()
    server.server.server_close()
    thread.join()


def decide(stand_in: StandIn, episode: Episode | None = None, timeout_s: float = 10.0) -> Any:
    async def run() -> Any:
        async with OpenAiPlanner(LlmConfig(stand_in.url, "m", "secret", timeout_s), PALETTE) as planner:
            return await planner.decide(episode or Episode("grab the red cube"))

    return asyncio.run(run())


def test_a_tool_call_is_decoded_and_only_allowed_skills_are_offered(stand_in: StandIn) -> None:
    stand_in.calls("locate_in_view", '{"query": "red cube", "rationale": "look first"}')
    assert decide(stand_in) == LocateInView(query="red cube", rationale="look first")
    (asked,) = stand_in.asked
    offered = {tool["function"]["name"]: tool["function"] for tool in asked["tools"]}
    assert set(offered) == {"execute_rskill", "locate_in_view", "query_scene", "finish"}
    assert offered["execute_rskill"]["parameters"]["properties"]["rskill_id"]["enum"] == ["lab/navigate"]
    assert asked["messages"][-1] == {"role": "user", "content": "grab the red cube"}


def test_the_episode_is_told_as_a_conversation(stand_in: StandIn) -> None:
    stand_in.calls("finish", '{"success": true, "reason": "done"}')
    episode = Episode(
        "grab it",
        [Step(ExecuteRskill(rskill_id="lab/navigate"), Outcome("failed", "blocked", data={"at": 1}))],
    )
    assert decide(stand_in, episode) == Finish(True, "done")
    call, result = stand_in.asked[0]["messages"][-2:]
    assert call["tool_calls"][0]["function"] == {
        "name": "execute_rskill",
        "arguments": '{"rskill_id":"lab/navigate"}',
    }
    assert json.loads(result["content"]) == {"status": "failed", "text": "blocked", "data": {"at": 1}}


def test_words_without_a_call_get_one_nudge_and_bad_calls_are_told_back(stand_in: StandIn) -> None:
    stand_in.says({"role": "assistant", "content": "I would look."})
    stand_in.calls("locate_in_view", '{"quary": "red cube"}')
    stand_in.calls("locate_in_view", '{"query": "red cube"}')
    assert decide(stand_in) == LocateInView(query="red cube")
    assert "exactly one tool call" in stand_in.asked[1]["messages"][-1]["content"]
    assert "quary" in stand_in.asked[2]["messages"][-1]["content"]


@pytest.mark.parametrize("arguments", ["{}", '{"success": "yes", "reason": "x"}', "not json"])
def test_it_gives_up_after_three_unusable_answers(stand_in: StandIn, arguments: str) -> None:
    for _ in range(3):
        stand_in.calls("finish", arguments)
    with pytest.raises(LlmError, match="no usable answer in 3 tries: finish"):
        decide(stand_in)


def test_a_silent_server_is_a_typed_error_within_the_time_limit(stand_in: StandIn) -> None:
    stand_in.answers.append((0, b""))
    with pytest.raises(LlmError, match=r"within 0\.2 s"):
        decide(stand_in, timeout_s=0.2)


@pytest.mark.parametrize(
    ("status", "body"),
    [(500, b"{}"), (200, b"<html>"), (200, b'{"choices": []}'), (200, b'{"choices": [{"message": 3}]}')],
)
def test_a_broken_answer_is_a_typed_error(stand_in: StandIn, status: int, body: bytes) -> None:
    stand_in.answers.append((status, body))
    with pytest.raises(LlmError):
        decide(stand_in)


def test_the_environment_is_checked() -> None:
    with pytest.raises(ConfigError, match="VRAM_REASONER_LLM_BASE_URL and VRAM_REASONER_LLM_MODEL"):
        LlmConfig.from_environ({})
    complete = {"VRAM_REASONER_LLM_BASE_URL": "http://x/v1/", "VRAM_REASONER_LLM_MODEL": "m"}
    assert LlmConfig.from_environ(complete).base_url == "http://x/v1"
    with pytest.raises(ConfigError, match="no number"):
        LlmConfig.from_environ(complete | {"VRAM_REASONER_LLM_TIMEOUT_S": "soon"})
