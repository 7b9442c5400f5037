"""How the servers of both APIs answer, and how their requests read; a palette to plan with."""

import json
from typing import Any

from vram_arbiter.reasoner.llm.anthropic import AnthropicPlanner
from vram_arbiter.reasoner.llm.base import LlmPlanner
from vram_arbiter.reasoner.llm.openai import OpenAiPlanner
from vram_arbiter.reasoner.palette import Palette, Skill

SCHEMA = {
    "type": "object",
    "properties": {"turn_rad": {"type": "number", "maximum": 3.2}},
    "additionalProperties": False,
}
PALETTE = Palette(
    (
        Skill("lab/navigate", "ros_action", "drive", ("navigate",), SCHEMA),
        Skill("lab/grab", "vla", "grab", ("grasp",)),
        Skill("lab/vlm", "vlm", "look", ("query",)),
    )
)
KEY = "sk-very-secret"


class OpenAi:
    """How this API's server answers, and how its requests read."""

    planner: type[LlmPlanner] = OpenAiPlanner
    base = "/v1"
    path = "/v1/chat/completions"

    @staticmethod
    def says(*calls: tuple[str, str], text: str = "") -> Any:
        made = [
            {"id": f"c{n}", "type": "function", "function": {"name": name, "arguments": arguments}}
            for n, (name, arguments) in enumerate(calls)
        ]
        message = {"role": "assistant", "content": text or None, "tool_calls": made or None}
        return {
            "model": "m-2026",
            "choices": [{"message": message, "finish_reason": "tool_calls" if made else "stop"}],
            "usage": {"prompt_tokens": 1200, "completion_tokens": 34, "total_tokens": 1234},
        }

    @staticmethod
    def offered(body: dict[str, Any]) -> dict[str, Any]:
        return {tool["function"]["name"]: tool["function"]["parameters"] for tool in body["tools"]}

    @staticmethod
    def told(body: dict[str, Any]) -> list[str]:
        """Everything that is said to the model after the instructions, in order: words, calls,
        results.
        """
        found = []
        for message in body["messages"]:
            if message["role"] == "system":
                continue
            for call in message.get("tool_calls", ()):
                found.append(f"{call['function']['name']} {call['function']['arguments']}")
            if isinstance(message["content"], str):
                found.append(message["content"])
        return found

    @staticmethod
    def system(body: dict[str, Any]) -> str:
        return str(body["messages"][0]["content"])

    @staticmethod
    def pictures(body: dict[str, Any]) -> list[str]:
        """The pictures that are shown, in base64."""
        return [
            part["image_url"]["url"].removeprefix("data:image/jpeg;base64,")
            for message in body["messages"]
            if isinstance(message["content"], list)
            for part in message["content"]
            if part["type"] == "image_url"
        ]

    @staticmethod
    def is_cut_off(text: str) -> Any:
        message = {"role": "assistant", "content": text}
        return {"choices": [{"message": message, "finish_reason": "length"}]}


class Anthropic:
    planner: type[LlmPlanner] = AnthropicPlanner
    base = ""
    path = "/v1/messages"

    @staticmethod
    def says(*calls: tuple[str, str], text: str = "") -> Any:
        content: list[dict[str, Any]] = [{"type": "text", "text": text}] if text else []
        for n, (name, arguments) in enumerate(calls):
            try:
                value = json.loads(arguments)
            except ValueError:
                value = arguments
            content.append({"type": "tool_use", "id": f"toolu_{n}", "name": name, "input": value})
        return {
            "type": "message",
            "role": "assistant",
            "model": "m-2026",
            "content": content,
            "stop_reason": "tool_use" if calls else "end_turn",
            "usage": {
                "input_tokens": 200,
                "cache_read_input_tokens": 1000,
                "cache_creation_input_tokens": None,
                "output_tokens": 34,
            },
        }

    @staticmethod
    def offered(body: dict[str, Any]) -> dict[str, Any]:
        return {tool["name"]: tool["input_schema"] for tool in body["tools"]}

    @staticmethod
    def told(body: dict[str, Any]) -> list[str]:
        found = []
        for message in body["messages"]:
            for block in message["content"]:
                match block["type"]:
                    case "text":
                        found.append(block["text"])
                    case "tool_use":
                        found.append(
                            f"{block['name']} {json.dumps(block['input'], separators=(',', ':'))}"
                        )
                    case "tool_result":
                        content = block["content"]
                        found.append(content if isinstance(content, str) else content[0]["text"])
        return found

    @staticmethod
    def system(body: dict[str, Any]) -> str:
        return str(body["system"])

    @staticmethod
    def pictures(body: dict[str, Any]) -> list[str]:
        return [
            part["source"]["data"]
            for message in body["messages"]
            for block in message["content"]
            if block["type"] == "tool_result" and isinstance(block["content"], list)
            for part in block["content"]
            if part["type"] == "image"
        ]

    @staticmethod
    def is_cut_off(text: str) -> Any:
        return Anthropic.says(text=text) | {"stop_reason": "max_tokens"}
