"""`vramctl demo --quick`: a real arbiter, a simulated GPU of 8 GiB, and three stand-in programs
that take turns on it (`demo_stand_in`). Needs the base install only.
"""

import asyncio
import sys
import time
from collections.abc import Callable, Sequence
from typing import Final

from vram_arbiter.clients.cli.demo_display import Display
from vram_arbiter.clients.cli.programs import private_arbiter
from vram_arbiter.clients.cli.timeline import chart, collect
from vram_arbiter.clients.cli.timeline.collect import Range
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE

STAND_INS: Final = {"detector": "5.3GB", "scene-vlm": "3.3GB", "grab": "4.3GB"}
LIMIT_S: Final = 60.0
"""It takes a third of that on two idle cores."""


def run() -> int:
    """Return 0 if all programs did their jobs, took turns, and never ran out of memory."""
    return asyncio.run(_demo())


async def _demo() -> int:
    print("starting the arbiter on a simulated GPU of 8 GiB, and three programs")
    async with private_arbiter("demo") as (programs, client):
        started = [
            await programs.start(name, "clients.cli.demo_stand_in", name, size)
            for name, size in STAND_INS.items()
        ]
        events = await follow(
            client, lambda: any(one.process.returncode is None for one in started)
        )
        failed = [one for one in started if one.process.returncode != 0]
        for program in failed:
            print(f"{program.name} did not do its jobs:\n{program.tail()}", file=sys.stderr)
        kinds = {event["kind"] for event in events}
        draw(events, programs.environ[ENDPOINT_VARIABLE])
        return 0 if not failed and "oom" not in kinds and "verified" in kinds else 1


async def follow(client: AsyncClient, unfinished: Callable[[], bool]) -> list[JsonMap]:
    """Print what happens while there is something unfinished, LIMIT_S at most. Returns the
    events."""
    events, began_s, going, display = list[JsonMap](), time.time(), True, Display()
    while going:
        going = time.time() - began_s < LIMIT_S and unfinished()
        for event in (await client.history(after=events[-1]["seq"] if events else 0)).events:
            events.append(event)
            display.event(event, event["at_wall_s"] - began_s)
        await asyncio.sleep(0.1)
    return events


def draw(events: Sequence[JsonMap], endpoint: str) -> None:
    """Print the timeline from the first grant on, if there was one."""
    if granted_s := [event["at_wall_s"] for event in events if event["kind"] == "granted"]:
        drawn = chart.lines(collect.from_history(Range(min(granted_s)), endpoint))
        print("\n" + "\n".join(drawn))
