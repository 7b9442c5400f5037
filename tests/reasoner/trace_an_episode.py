"""Prints the spans of one episode as JSON: a program of its own, because a process has one tracer
provider for good.

A call that is refused; a goal beside which an operator speaks, so that a second decision is asked
for and thrown away by the goal's end; an end.
"""

import asyncio
import json

from opentelemetry import trace
from opentelemetry.sdk.trace import TracerProvider
from opentelemetry.sdk.trace.export import SimpleSpanProcessor
from opentelemetry.sdk.trace.export.in_memory_span_exporter import InMemorySpanExporter

from vram_arbiter.reasoner.inbox import Inbox, Said
from vram_arbiter.reasoner.loop import run_episode
from vram_arbiter.reasoner.palette import Palette, Skill
from vram_arbiter.reasoner.planner import Episode, Finish, Outcome
from vram_arbiter.schemas.runtime.telemetry import spans as tracing
from vram_arbiter.schemas.tools import ExecuteRskill, ToolCall

PALETTE = Palette((Skill("lab/grab", "vla", "grab", ("grasp",)),))


class Story:
    """Planner and robot in one: the robot ends once the planner was asked beside it."""

    def __init__(self) -> None:
        self.inbox = Inbox()
        self.asked_beside = asyncio.Event()
        self.handed_on: str | None = None

    async def decide(self, episode: Episode) -> ToolCall | Finish:
        if episode.running is not None:
            self.asked_beside.set()
            await asyncio.Event().wait()
        if not episode.steps:
            return ExecuteRskill(rskill_id="lab/unknown")
        if len(episode.steps) == 1:
            return ExecuteRskill(rskill_id="lab/grab")
        return Finish(True, "done")

    async def dispatch(self, call: ToolCall) -> Outcome:
        self.handed_on = tracing.traceparent()
        self.inbox.put(Said("slowly"))
        await self.asked_beside.wait()
        return Outcome("succeeded", "there")


async def main() -> None:
    exporter, provider = InMemorySpanExporter(), TracerProvider()
    provider.add_span_processor(SimpleSpanProcessor(exporter))
    trace.set_tracer_provider(provider)
    story = Story()
    with tracing.span("task"):
        await run_episode("x", story, PALETTE, story.dispatch, inbox=story.inbox)
        await asyncio.sleep(0)  # the decision that was thrown away hears of it
    spans = [
        {
            "name": span.name,
            "span_id": f"{span.context.span_id:016x}",
            "parent": f"{span.parent.span_id:016x}" if span.parent else None,
            "attributes": dict(span.attributes or {}),
            "start": span.start_time,
        }
        for span in exporter.get_finished_spans()
    ]
    print(json.dumps({"spans": spans, "handed_on": story.handed_on}))


if __name__ == "__main__":
    asyncio.run(main())
