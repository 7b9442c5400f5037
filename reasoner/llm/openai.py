"""A planner behind any OpenAI-compatible `/chat/completions` (vLLM, Ollama, llama.cpp, cloud).

Facts: the wire is the public Chat Completions API (messages, tools, tool_calls). `tool_choice` is
`auto`: not every server knows `required`.
"""

import json
from collections.abc import Sequence
from typing import Any

from vram_arbiter.reasoner.cascade import Answered, Called, Thought, Turn, Words
from vram_arbiter.reasoner.llm.base import Answer, Call, LlmConfig, LlmPlanner
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.tools import FunctionTool

__all__ = ["LlmConfig", "OpenAiPlanner"]


class OpenAiPlanner(LlmPlanner):
    """`BASE_URL` ends where the API begins, usually in `/v1`."""

    def _headers(self) -> dict[str, str]:
        return {"authorization": f"Bearer {self.config.api_key}"} if self.config.api_key else {}

    def _request(
        self, turns: Sequence[Turn], functions: Sequence[FunctionTool]
    ) -> tuple[str, JsonObject]:
        messages = [{"role": "system", "content": self._system}, *map(_message, turns)]
        return f"{self.config.base_url}/chat/completions", {
            "model": self.config.model,
            "messages": messages,
            "tools": list(functions),
            "tool_choice": "auto",
            "temperature": 0,
            "max_tokens": self.config.max_tokens,
        }

    def _read(self, body: JsonObject) -> Answer:
        message = body["choices"][0]["message"]
        calls = message.get("tool_calls") or []
        if not isinstance(calls, list):
            raise TypeError("tool_calls is not a list")
        return Answer(str(message.get("content") or ""), tuple(map(_call, calls)))


def _call(call: Any) -> Call:
    function = call["function"]
    arguments = function.get("arguments")
    if not isinstance(arguments, str | dict | None):
        arguments = str(arguments)
    return Call(str(call.get("id") or ""), str(function["name"]), arguments or "{}")


def _message(turn: Turn) -> JsonObject:
    match turn:
        case Words(text):
            return {"role": "user", "content": text}
        case Thought(text):
            return {"role": "assistant", "content": text}
        case Called(call_id, name, arguments):
            function = {
                "name": name,
                "arguments": json.dumps(arguments, ensure_ascii=False, separators=(",", ":")),
            }
            return {
                "role": "assistant",
                "content": None,
                "tool_calls": [{"id": call_id, "type": "function", "function": function}],
            }
        case Answered(call_id, text):
            return {"role": "tool", "tool_call_id": call_id, "content": text}
