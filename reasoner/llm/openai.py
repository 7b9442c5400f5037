"""A planner behind any OpenAI-compatible `/chat/completions` (vLLM, Ollama, llama.cpp, the cloud).

The episode is told as a conversation: each call an assistant message with a tool call, each outcome a tool message. Answers are decoded strictly
by `schemas.tools`; what cannot be understood is told back to the model, at most `RETRIES_MAX` times a decision. Facts: the wire is the public
Chat Completions API (messages, tools, tool_calls).
"""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Self

from reasoner.palette import Palette
from reasoner.planner import Episode, Finish, Outcome, Step
from schemas.errors import BadRequest, ConfigError, LlmError, UnknownOp
from schemas.tools import ToolCall, parse_tool_call

RETRIES_MAX = 3
TIMEOUT_S = 60.0
MAX_TOKENS = 512

SYSTEM = """You control a mobile robot with one arm by calling tools, one at a time.
Find the named object, drive to it (execute_rskill of the navigation skill with goal_params_json {"target_point": {"x", "y", "z"}} taken from locate_in_view),
grab it, and ask the scene model, camera "wrist", whether it is grasped. After a failed grasp look again and retry, at most three attempts.
"evicted" or "error" means that nothing was looked at: it never means that the object is absent. Call `finish` when done."""

NUDGE = "Answer with exactly one tool call."

FINISH = {
    "type": "function",
    "function": {
        "name": "finish",
        "description": "End the task.",
        "parameters": {
            "type": "object",
            "properties": {"success": {"type": "boolean"}, "reason": {"type": "string"}},
            "required": ["success", "reason"],
            "additionalProperties": False,
        },
    },
}


@dataclass(frozen=True, slots=True)
class LlmConfig:
    """Where the model is. `timeout_s` bounds one request."""

    base_url: str
    model: str
    api_key: str = ""
    timeout_s: float = TIMEOUT_S
    max_tokens: int = MAX_TOKENS

    @classmethod
    def from_environ(cls, environ: Mapping[str, str]) -> Self:
        """Read `VRAM_REASONER_LLM_{BASE_URL,MODEL,API_KEY,TIMEOUT_S}`. Raises ConfigError for what is missing or no number."""
        prefix = "VRAM_REASONER_LLM_"
        missing = [prefix + name for name in ("BASE_URL", "MODEL") if not environ.get(prefix + name)]
        if missing:
            raise ConfigError(
                f"{' and '.join(missing)} not set", hint="export them, or use the scripted planner"
            )
        try:
            timeout_s = float(environ.get(prefix + "TIMEOUT_S", TIMEOUT_S))
        except ValueError:
            raise ConfigError(
                f"{prefix}TIMEOUT_S is no number of seconds: {environ[prefix + 'TIMEOUT_S']!r}"
            ) from None
        return cls(
            environ[prefix + "BASE_URL"].rstrip("/"),
            environ[prefix + "MODEL"],
            environ.get(prefix + "API_KEY", ""),
            timeout_s,
        )


class OpenAiPlanner:
    """`Planner` by a language model. `async with` closes its connections."""

    def __init__(self, config: LlmConfig, palette: Palette) -> None:
        import httpx  # only installed with the reasoner's extra

        self._config = config
        self._tools = [*palette.functions(), FINISH]
        headers = {"Authorization": f"Bearer {config.api_key}"} if config.api_key else {}
        self._http = httpx.AsyncClient(headers=headers, timeout=config.timeout_s)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.aclose()

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        messages = _conversation(episode)
        problem = ""
        for _ in range(RETRIES_MAX):
            message = await self._complete(messages)
            calls = message.get("tool_calls") or []
            if not calls:
                problem = "no tool call"
                messages += [
                    {"role": "assistant", "content": str(message.get("content") or "")},
                    {"role": "user", "content": NUDGE},
                ]
                continue
            try:
                return _decision(calls[0])
            except (BadRequest, UnknownOp) as error:
                problem = str(error)
                messages += [
                    {"role": "assistant", "content": json.dumps(calls[0])},
                    {"role": "user", "content": f"{problem} {NUDGE}"},
                ]
        raise LlmError(
            f"no usable answer in {RETRIES_MAX} tries: {problem}",
            hint="try a model that is better at calling tools",
        )

    async def _complete(self, messages: list[dict[str, Any]]) -> dict[str, Any]:
        import httpx

        body = {
            "model": self._config.model, "messages": messages, "tools": self._tools, "tool_choice": "auto", "temperature": 0,
            "max_tokens": self._config.max_tokens,
        }  # fmt: skip
        url = f"{self._config.base_url}/chat/completions"
        try:
            response = await self._http.post(url, json=body)
            response.raise_for_status()
            message = response.json()["choices"][0]["message"]
        except httpx.TimeoutException as error:
            raise LlmError(
                f"no answer from {url} within {self._config.timeout_s} s",
                hint="raise VRAM_REASONER_LLM_TIMEOUT_S",
            ) from error
        except httpx.HTTPError as error:
            raise LlmError(f"{url}: {error}", hint="is the server running, and the key right?") from error
        except (ValueError, LookupError, TypeError) as error:
            raise LlmError(f"{url} answered something that is no chat completion: {error!r}") from error
        if not isinstance(message, dict):
            raise LlmError(f"{url} answered something that is no chat completion")
        return message


def _decision(call: Any) -> ToolCall | Finish:
    function = call.get("function") if isinstance(call, dict) else None
    if not isinstance(function, dict):
        raise BadRequest("a tool call without a function")
    name, arguments = str(function.get("name")), function.get("arguments") or "{}"
    if name != "finish":
        return parse_tool_call(name, arguments)
    try:
        fields = json.loads(arguments) if isinstance(arguments, str) else dict(arguments)
        success, reason = fields["success"], fields["reason"]
    except (ValueError, KeyError, TypeError) as error:
        raise BadRequest(f"finish: needs success (boolean) and reason (text): {error!r}") from None
    if not isinstance(success, bool):
        raise BadRequest("finish: success must be true or false")
    return Finish(success, str(reason))


def _conversation(episode: Episode) -> list[dict[str, Any]]:
    messages: list[dict[str, Any]] = [
        {"role": "system", "content": SYSTEM},
        {"role": "user", "content": episode.task},
    ]
    for number, step in enumerate(episode.steps):
        messages += _told(f"call-{number}", step)
    return messages


def _told(call_id: str, step: Step) -> list[dict[str, Any]]:
    arguments = step.call.model_dump_json(exclude={"tool"}, exclude_defaults=True)
    call = {"id": call_id, "type": "function", "function": {"name": step.call.tool, "arguments": arguments}}
    return [
        {"role": "assistant", "content": None, "tool_calls": [call]},
        {"role": "tool", "tool_call_id": call_id, "content": json.dumps(_summary(step.outcome))},
    ]


def _summary(outcome: Outcome) -> dict[str, Any]:
    return {"status": outcome.status, "text": outcome.text} | (
        {"data": dict(outcome.data)} if outcome.data else {}
    )
