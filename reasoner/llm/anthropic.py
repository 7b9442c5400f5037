"""A planner behind Anthropic's Messages API, or a server that speaks it.

Facts: the public API, version 2023-06-01. `POST /v1/messages` with `x-api-key`; a call is a
`tool_use` block of the assistant and its result a `tool_result` block at the head of the next user
message; adjacent messages of one role are merged; no text may be empty. `tool_choice: any` demands
a call, and `disable_parallel_tool_use` limits it to one. A result may have a picture in it.
"""

import base64
from collections.abc import Sequence
from typing import Any, ClassVar

from vram_arbiter.reasoner.cascade import Answered, Called, Thought, Turn, Words
from vram_arbiter.reasoner.llm.answer import Answer, Call
from vram_arbiter.reasoner.llm.base import LlmPlanner, tokens
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.tools import FunctionTool

VERSION = "2023-06-01"


class AnthropicPlanner(LlmPlanner):
    """`BASE_URL` is the server without `/v1`; by default Anthropic's own."""

    provider: ClassVar[str] = "anthropic"
    default_base_url: ClassVar[str] = "https://api.anthropic.com"

    def _headers(self) -> dict[str, str]:
        headers = {"anthropic-version": VERSION}
        return headers | {"x-api-key": self.config.api_key} if self.config.api_key else headers

    def _request(
        self, turns: Sequence[Turn], functions: Sequence[FunctionTool]
    ) -> tuple[str, JsonObject]:
        tools = [
            {
                "name": function["function"]["name"],
                "description": function["function"]["description"],
                "input_schema": function["function"]["parameters"],
            }
            for function in functions
        ]
        return f"{self.config.base_url.removesuffix('/v1')}/v1/messages", {
            "model": self.config.model,
            "max_tokens": self.config.max_tokens,
            "system": self._system,
            "messages": _messages(turns),
            "tools": tools,
            "tool_choice": {"type": "any", "disable_parallel_tool_use": True},
        }

    def _read(self, body: JsonObject) -> Answer:
        if body["type"] != "message" or body["role"] != "assistant":
            raise ValueError(f"a {body['type']}, not a message of the assistant")
        blocks = body["content"]
        if not isinstance(blocks, list):
            raise TypeError("content is not a list of blocks")
        words = [str(block["text"]) for block in blocks if block["type"] == "text"]
        calls = [
            Call(str(block["id"]), str(block["name"]), _input(block["input"]))
            for block in blocks
            if block["type"] == "tool_use"
        ]
        usage = body.get("usage") or {}
        read = ("input_tokens", "cache_creation_input_tokens", "cache_read_input_tokens")
        return Answer(
            " ".join(words),
            tuple(calls),
            str(body.get("stop_reason") or ""),
            str(body.get("model") or ""),
            sum(tokens(usage.get(name)) for name in read),
            tokens(usage.get("output_tokens")),
        )


def _input(value: Any) -> JsonMap | str:
    return value if isinstance(value, dict) else str(value)


def _messages(turns: Sequence[Turn]) -> list[JsonObject]:
    messages: list[JsonObject] = []
    for turn in turns:
        role, block = _block(turn)
        if messages and messages[-1]["role"] == role:
            messages[-1]["content"].append(block)
        else:
            messages.append({"role": role, "content": [block]})
    return messages


def _block(turn: Turn) -> tuple[str, JsonObject]:
    match turn:
        case Words(text):
            return "user", {"type": "text", "text": text.strip() or "…"}
        case Thought(text):
            return "assistant", {"type": "text", "text": text.strip() or "…"}
        case Called(call_id, name, arguments):
            return "assistant", {
                "type": "tool_use",
                "id": call_id,
                "name": name,
                "input": arguments,
            }
        case Answered(call_id, text, is_error, picture):
            content = [{"type": "text", "text": text}, _shown(picture)] if picture else text
            result = {"type": "tool_result", "tool_use_id": call_id, "content": content}
            return "user", result | {"is_error": True} if is_error else result


def _shown(picture: bytes) -> JsonObject:
    data = base64.b64encode(picture).decode()
    return {
        "type": "image",
        "source": {"type": "base64", "media_type": "image/jpeg", "data": data},
    }
