"""A story as lines of text, for a terminal. Pure."""

import time
from typing import Final

from vram_arbiter.clients.cli.text import duration
from vram_arbiter.clients.cli.timeline.story import AWAY, LEAVING, GpuStory, Story
from vram_arbiter.clients.cli.timeline.trace import steps_of
from vram_arbiter.schemas.runtime.printable import makes_printable
from vram_arbiter.schemas.sizes import format_bytes

NAME_CHARS, CELLS = 20, 72
_BLOCKS: Final = " ▁▂▃▄▅▆▇█"
_SIGNS: Final = {
    **dict.fromkeys(AWAY, "░"), "queued": "·", "loading": "▒", "held": "█",
    **dict.fromkeys(LEAVING, "▼"),
}  # fmt: skip
_KEY: Final = "· waits   ▒ loads   █ held   ▼ leaves   ░ standby or parked"


@makes_printable
def lines(story: Story) -> list[str]:
    """Return the charged bytes of each GPU and the states of each consumer, from left to right."""
    began = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(story.begin_s))
    found = [f"{duration(story.end_s - story.begin_s)} from {began}"]
    found += [f"{_name(gpu.title)}  {_bars(story, gpu)}" for gpu in story.gpus]
    for name in story.consumers:
        cells = [" "] * CELLS
        for lease in story.leases:
            for span in lease.states if lease.consumer == name else ():
                first, last = _cell(story, span.begin_s), _cell(story, span.end_s)
                cells[first : last + 1] = _SIGNS.get(span.name, "?") * (last + 1 - first)
        found.append(f"{_name(name)}  {''.join(cells)}".rstrip())
    return [*found, _KEY, *story.notices]


def _bars(story: Story, gpu: GpuStory) -> str:
    steps = [(at, sum(counts.values())) for at, counts in steps_of(story.bytes_by_name(gpu))]
    top = max([1, gpu.capacity_bytes, *(count for _, count in steps)])
    levels = [0] * CELLS
    for at_s, count in steps:
        first = _cell(story, at_s)
        levels[first:] = [count] * (CELLS - first)
    bars = "".join(_BLOCKS[-(-8 * level // top)] for level in levels)
    return f"{bars}  of {format_bytes(top)}"


def _cell(story: Story, at_s: float) -> int:
    share = (at_s - story.begin_s) / max(1e-9, story.end_s - story.begin_s)
    return min(CELLS - 1, max(0, int(share * CELLS)))


def _name(text: str) -> str:
    return text[:NAME_CHARS].ljust(NAME_CHARS)
