"""Base of all language-model planners: decisions out of answers, and what is said to wrong ones.

A backend turns the conversation into its API's request and its API's answer into `Answer`;
everything else is here. Strict: exactly one call, of an offered tool, with the described arguments.
Text without a call gets one nudge; an unreadable call is reported back; after `TRIES_MAX` answers
the decision has failed.
"""

import asyncio
import re
from abc import ABC, abstractmethod
from collections.abc import Sequence
from typing import ClassVar, Self

from vram_arbiter.reasoner.cascade import Answered, Called, Thought, Turn, Words, conversation
from vram_arbiter.reasoner.llm.answer import Answer, Call
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.llm.http import JsonHttp, Pause, without_credentials
from vram_arbiter.reasoner.llm.measured import Tally, measured
from vram_arbiter.reasoner.llm.prompt import instructions
from vram_arbiter.reasoner.llm.transcript import Transcript
from vram_arbiter.reasoner.palette import FINISH, Palette
from vram_arbiter.reasoner.planner import Episode, Finish, benched
from vram_arbiter.schemas.errors import BadRequest, LlmError, NotPermitted, UnknownOp
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.tools import FunctionTool, ToolCall, read_arguments

TRIES_MAX = 3
CUT_OFF = frozenset({"length", "max_tokens"})  # what the two APIs say of an answer without its end

NUDGE = "Answer with exactly one tool call."


FINISHING: FunctionTool = {
    "type": "function",
    "function": {
        "name": FINISH,
        "description": "End the task.",
        "parameters": {
            "type": "object",
            "properties": {"success": {"type": "boolean"}, "reason": {"type": "string"}},
            "required": ["success", "reason"],
            "additionalProperties": False,
        },
    },
}


class LlmPlanner(ABC):
    """`Planner` by a language model. `async with` closes its connections.

    `procedure` is a playbook's text, which comes after the general instructions. `pause` waits
    before a request is tried again.
    """

    default_base_url: ClassVar[str] = ""
    provider: ClassVar[str] = ""
    """As `gen_ai.provider.name` spells it."""

    def __init__(
        self,
        config: LlmConfig,
        palette: Palette,
        *,
        procedure: str = "",
        transcript: Transcript | None = None,
        pause: Pause = asyncio.sleep,
    ) -> None:
        self.config = config
        self.tally = Tally()
        self._palette = palette
        self._system = instructions(palette, procedure)
        self._transcript = transcript or Transcript(None)
        self._http = JsonHttp(self._headers(), config, pause, self.tally.tried_again)

    async def __aenter__(self) -> Self:
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._http.close()

    # -- what a backend says
    @abstractmethod
    def _headers(self) -> dict[str, str]:
        """Version and key, as the API wants them."""

    @abstractmethod
    def _request(
        self, turns: Sequence[Turn], functions: Sequence[FunctionTool]
    ) -> tuple[str, JsonObject]:
        """Address and body of a request. `functions` are OpenAI-style descriptions."""

    @abstractmethod
    def _read(self, body: JsonObject) -> Answer:
        """Read the API's answer. Raises ValueError, LookupError or TypeError for another body."""

    # -- a decision
    async def decide(self, episode: Episode) -> ToolCall | Finish:
        goal_runs = episode.running is not None
        palette = self._palette.without(benched(episode.steps))
        functions = [*palette.functions(goal_runs=goal_runs), FINISHING]
        offered = {str(function["function"]["name"]) for function in functions}
        turns = conversation(episode, palette)
        problem, nudged = "", False
        for number in range(TRIES_MAX):
            answer = await self._ask(turns, functions)
            if not answer.calls:
                problem = "no tool call"
                if answer.finish_reason in CUT_OFF:
                    self._rejected("cut off")
                    raise LlmError(
                        f"the answer was cut off after {self.config.max_tokens} tokens, before a"
                        " tool call",
                        hint="raise VRAM_REASONER_LLM_MAX_TOKENS",
                    )
                self._rejected(problem)
                if nudged:
                    break
                nudged = True
                turns += [Thought(answer.text), Words(NUDGE)]
                continue
            call = answer.calls[0]
            try:
                if len(answer.calls) > 1:
                    raise BadRequest(f"{len(answer.calls)} tool calls at once")
                return _decision(call, palette, offered, goal_runs=goal_runs)
            except (BadRequest, UnknownOp, NotPermitted) as error:
                problem = str(error)
                self._rejected(problem)
                turns += _told_back(f"try-{number}", call, problem)
        raise LlmError(
            f"no usable answer in {TRIES_MAX} tries: {problem}",
            hint="try a model that is better at calling tools",
        )

    def _rejected(self, problem: str) -> None:
        self.tally.rejected += 1
        self._transcript.tell("rejected", problem=problem)
        tracing.event(telemetry.EVENT_ANSWER_REJECTED, **{telemetry.ATTR_REASON: problem})

    async def _ask(self, turns: Sequence[Turn], functions: Sequence[FunctionTool]) -> Answer:
        url, body = self._request(turns, functions)
        with measured(self.provider, self.config, self.tally) as answered:
            try:
                reply = await self._http.post(url, body)
                answer = self._read(reply)
            except LlmError as error:
                self._transcript.tell("failed", request=body, problem=str(error))
                raise
            except (ValueError, LookupError, TypeError, AttributeError) as error:
                self._transcript.tell("failed", request=body, problem=repr(error))
                raise LlmError(
                    f"{without_credentials(url)} did not answer as this API does: {error!r}",
                    hint="is it the right backend?",
                ) from error
            self._transcript.tell("answered", request=body, answer=reply)
            answered(answer)
        return answer


def _decision(
    call: Call, palette: Palette, offered: set[str], *, goal_runs: bool
) -> ToolCall | Finish:
    if call.name == FINISH:
        return _finish(call.arguments)
    try:
        decoded = palette.parse(call.name, call.arguments)
    except UnknownOp as error:  # its hint names every tool that there is
        raise UnknownOp(error.message, hint=palette.choice(goal_runs=goal_runs)) from None
    if call.name not in offered:
        # a skill that cannot be executed, for example: the loop refuses it, with the reason, as a
        # step of the episode
        if goal_runs:
            raise NotPermitted(
                f"a goal runs: {call.name} has to wait", hint=palette.choice(goal_runs=True)
            )
        return decoded
    if isinstance(refusal := palette.check(decoded, goal_runs=goal_runs), BadRequest):
        raise refusal
    return decoded


def _finish(arguments: str | JsonMap) -> Finish:
    fields = read_arguments(FINISH, arguments)
    success, reason = fields.get("success"), fields.get("reason")
    if not isinstance(success, bool) or not isinstance(reason, str):
        raise BadRequest("finish: needs success (boolean) and reason (text)")
    if stray := fields.keys() - {"success", "reason", "rationale"}:
        raise BadRequest(f"finish: {min(stray)}: is not an argument of this function")
    return Finish(success, reason)


def _told_back(call_id: str, call: Call, problem: str) -> list[Turn]:
    """Return the unusable call and the reason.

    Arguments that are not a JSON object are quoted: the API would not take them back.
    """
    try:
        arguments = read_arguments(call.name, call.arguments)
    except BadRequest:
        arguments = {"unreadable": str(call.arguments)[:500]}
    name = re.sub(r"[^A-Za-z0-9_-]", "_", call.name)
    return [
        Called(call_id, name[:64] or "unnamed", arguments),
        Answered(call_id, f"{problem} {NUDGE}", is_error=True),
    ]


def tokens(count: object) -> int:
    """Return a count of a server's `usage`; 0 for one that is not a count."""
    return count if isinstance(count, int) and not isinstance(count, bool) and count > 0 else 0
