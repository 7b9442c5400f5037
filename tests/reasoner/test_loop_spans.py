"""An episode's spans: one tick from the question to what came of the answer, with every decision
and the tool's work in it.
"""

import asyncio
from typing import Any

import pytest

from vram_arbiter.reasoner.inbox import Inbox, Said
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome
from vram_arbiter.schemas.runtime.telemetry import names as telemetry
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.tools import ExecuteRskill, ToolCall

pytestmark = [pytest.mark.anyio, pytest.mark.heavy]  # the OpenTelemetry SDK

PALETTE = Palette((Skill("lab/grab", "vla", "grab", ("grasp",)),))


class Story:
    """Planner and robot in one: a call that is refused; a goal beside which an operator speaks, so
    that a second decision is asked for and thrown away by the goal's end; an end.
    """

    def __init__(self) -> None:
        self.inbox = Inbox()
        self.asked_beside = asyncio.Event()
        self.handed_on = ""

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        if episode.running is not None:
            self.asked_beside.set()
            await asyncio.Event().wait()
        if len(episode.steps) == 2:
            return Finish(True, "done")
        return ExecuteRskill(rskill_id="lab/grab" if episode.steps else "lab/unknown")

    async def dispatch(self, call: ToolCall) -> Outcome:
        self.handed_on = tracing.traceparent() or ""
        self.inbox.put(Said("slowly"))
        await self.asked_beside.wait()
        return Outcome("succeeded", "there")


async def test_each_turn_of_an_episode_is_a_tick_with_its_decisions_and_its_tool(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    from opentelemetry.sdk.trace import TracerProvider
    from opentelemetry.sdk.trace.export import SimpleSpanProcessor
    from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    monkeypatch.setattr(tracing, "_TRACER", provider.get_tracer("test"))
    story = Story()
    with tracing.span("task"):
        await run_episode("x", story, PALETTE, story.dispatch, inbox=story.inbox)
        await asyncio.sleep(0)  # the decision that was thrown away hears of it
    spans: list[Any] = sorted(exporter.get_finished_spans(), key=lambda span: span.start_time)
    (task,) = [span for span in spans if span.parent is None]

    def below(parent: Any) -> list[Any]:
        ours = parent.context.span_id
        return [span for span in spans if span.parent and span.parent.span_id == ours]

    def named(found: list[Any]) -> list[tuple[str, str]]:
        return [(span.name, span.attributes[telemetry.ATTR_OUTCOME]) for span in found]

    tick, plan, tool = telemetry.SPAN_REASONER_TICK, telemetry.SPAN_PLAN, telemetry.SPAN_TOOL
    refused, grabbed, finished = below(task)
    assert named(below(task)) == [(tick, "refused"), (tick, "succeeded"), (tick, "finished")]
    assert named(below(refused)) == [(plan, "execute_rskill")]
    assert named(below(grabbed)) == [
        (plan, "execute_rskill"), (tool, "succeeded"), (plan, "superseded"),
    ]  # fmt: skip
    assert named(below(finished)) == [(plan, "finish")]
    (acted,) = [span for span in spans if span.name == tool]
    assert acted.attributes[telemetry.ATTR_SKILL] == "lab/grab"
    assert story.handed_on.split("-")[2] == f"{acted.context.span_id:016x}", (
        "the runner's goal is the tool's child"
    )
