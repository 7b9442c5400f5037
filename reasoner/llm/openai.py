"""A planner behind any OpenAI-compatible `/chat/completions` (vLLM, Ollama, llama.cpp, cloud).

Facts: the wire is the public Chat Completions API (messages, tools, tool_calls). `tool_choice` is
`auto`: not every server knows `required`. Temperature is the server's own: models that think first
refuse another. A tool's result is text; a picture follows it as a message of the user.
"""

import base64
import json
import logging
from collections.abc import Sequence
from typing import Any, ClassVar

from vram_arbiter.reasoner.cascade import Answered, Called, Thought, Turn, Words
from vram_arbiter.reasoner.llm.answer import Answer, Call
from vram_arbiter.reasoner.llm.base import LlmPlanner, tokens
from vram_arbiter.schemas.errors import LlmError
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.tools import FunctionTool

log = logging.getLogger(__name__)

REFUSABLE = ("parallel_tool_calls", "max_completion_tokens")
"""Parameters that some servers refuse: o1, o3 and o4-mini the first, older ones the second."""


class OpenAiPlanner(LlmPlanner):
    """`BASE_URL` ends where the API begins, usually in `/v1`."""

    provider: ClassVar[str] = "openai"
    _refused: frozenset[str] = frozenset()

    async def _ask(self, turns: Sequence[Turn], functions: Sequence[FunctionTool]) -> Answer:
        try:
            return await super()._ask(turns, functions)
        except LlmError as error:
            named = {name for name in REFUSABLE if f"'{name}'" in str(error)} - self._refused
            if not named:
                raise
            log.warning("%s: asking without it from now on", error.message)
            self._refused |= named
        return await self._ask(turns, functions)

    def _headers(self) -> dict[str, str]:
        return {"authorization": f"Bearer {self.config.api_key}"} if self.config.api_key else {}

    def _request(
        self, turns: Sequence[Turn], functions: Sequence[FunctionTool]
    ) -> tuple[str, JsonObject]:
        messages = [{"role": "system", "content": self._system}]
        for turn in turns:
            messages += _messages(turn)
        limit = "max_completion_tokens"
        body: JsonObject = {
            "model": self.config.model,
            "messages": messages,
            "tools": list(functions),
            "tool_choice": "auto",
            "max_tokens" if limit in self._refused else limit: self.config.max_tokens,
        }
        if "parallel_tool_calls" not in self._refused:
            body["parallel_tool_calls"] = False
        return f"{self.config.base_url}/chat/completions", body

    def _read(self, body: JsonObject) -> Answer:
        choice = body["choices"][0]
        message = choice["message"]
        calls = message.get("tool_calls") or []
        if not isinstance(calls, list):
            raise TypeError("tool_calls is not a list")
        usage = body.get("usage") or {}
        return Answer(
            str(message.get("content") or message.get("refusal") or ""),
            tuple(map(_call, calls)),
            str(choice.get("finish_reason") or ""),
            str(body.get("model") or ""),
            tokens(usage.get("prompt_tokens")),
            tokens(usage.get("completion_tokens")),
        )


def _call(call: Any) -> Call:
    function = call["function"]
    arguments = function.get("arguments")
    if not isinstance(arguments, str | dict | None):
        arguments = str(arguments)
    return Call(str(call.get("id") or ""), str(function["name"]), arguments or "{}")


def _messages(turn: Turn) -> list[JsonObject]:
    match turn:
        case Words(text):
            return [{"role": "user", "content": text}]
        case Thought(text):
            return [{"role": "assistant", "content": text}]
        case Called(call_id, name, arguments):
            function = {
                "name": name,
                "arguments": json.dumps(arguments, ensure_ascii=False, separators=(",", ":")),
            }
            call = {"id": call_id, "type": "function", "function": function}
            return [{"role": "assistant", "content": None, "tool_calls": [call]}]
        case Answered(call_id, text, picture=picture):
            result = {"role": "tool", "tool_call_id": call_id, "content": text}
            return [result, _shown(call_id, picture)] if picture else [result]


def _shown(call_id: str, picture: bytes) -> JsonObject:
    url = f"data:image/jpeg;base64,{base64.b64encode(picture).decode()}"
    return {
        "role": "user",
        "content": [
            {"type": "text", "text": f"The picture of {call_id}."},
            {"type": "image_url", "image_url": {"url": url}},
        ],
    }
