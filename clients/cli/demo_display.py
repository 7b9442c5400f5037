"""The demo's live display: the GPU as a bar, the leases as a table, the last switches, and where
the robot is.

On a terminal it redraws in place; into a file or a CI log it prints one line per event. It sends no
requests.
"""

import sys
from collections import deque
from types import TracebackType
from typing import Self

from rich.console import Console, Group, RenderableType
from rich.live import Live
from rich.panel import Panel
from rich.table import Table
from rich.text import Text

from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.units import format_bytes

BAR_CELLS = 60
EVENTS_SHOWN = 9
QUIET_KINDS = frozenset(
    {"use_began", "use_ended", "queued", "revoke_acked", "released", "probe_ok"}
)
COLOURS = {"detector": "red", "scene-vlm": "blue", "grab": "green"}


def describe(event: JsonMap) -> str:
    """One history event as a sentence, without its time."""
    who = str(event.get("consumer", event.get("lease_id", "")))
    match event["kind"]:
        case "revoke_asked":
            return f"{who}: revoked ({event.get('reason', '')})"
        case "verified":
            return (
                f"{who}: memory measured back, verdict {event.get('verdict')} after "
                f"{event.get('verify_ms', event.get('ms', 0)):.0f} ms"
            )
        case "switch" if event["switched"]:
            gone = ", ".join(victim["consumer"] for victim in event["evicted"])
            return f"{who} took over from {gone} in {event['total_ms']:.0f} ms"
        case "switch":
            return f"{who} loaded beside the others in {event['load_ms']:.0f} ms, no eviction"
        case kind:
            reason = event.get("reason", "")
            return f"{who or 'arbiter'}: {kind}" + (f" ({reason})" if reason else "")


class Display:
    """`with Display(task) as display:` then `show` with what is known."""

    def __init__(self, task: str, *, arbiter: bool) -> None:
        self._task = task
        self._arbiter = arbiter
        self._console = Console(file=sys.stdout)
        self._live = (
            Live(console=self._console, refresh_per_second=6) if self._console.is_terminal else None
        )
        self._events: deque[str] = deque(maxlen=EVENTS_SHOWN)
        self._robot = ""

    def __enter__(self) -> Self:
        if self._live is not None:
            self._live.start()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        if self._live is not None:
            self._live.stop()

    def say(self, text: str) -> None:
        """A line of the demo itself."""
        text = printable(text)
        self._events.append(text)
        if self._live is None:
            self._console.print(text, markup=False, highlight=False)

    def event(self, event: JsonMap, at_s: float) -> None:
        """A history event of the arbiter, `at_s` seconds after the start."""
        if event["kind"] not in QUIET_KINDS:
            self.say(f"{at_s:6.1f} s  {describe(event)}")

    def robot(self, line: str, at_s: float) -> None:
        """What the reasoner does now."""
        line = printable(line)
        if line and line != self._robot:
            self._robot = line
            if self._live is None:
                self._console.print(f"{at_s:6.1f} s  robot: {line}", markup=False, highlight=False)

    def show(self, status: JsonMap | None) -> None:
        """Redraw from the arbiter's status (None: there is no arbiter)."""
        if self._live is None:
            return
        parts: list[RenderableType] = [
            Text(f"task: {printable(self._task)}", style="bold"),
            Text(f"robot: {self._robot}"),
        ]
        if status is not None:
            parts += [_bar(gpu, status["leases"]) for gpu in status["gpus"]]
            parts.append(_table(status["leases"]))
        parts.append(Text("\n".join(self._events)))
        title = "vram-arbiter demo" if self._arbiter else "the same loop WITHOUT the arbiter"
        self._live.update(Panel(Group(*parts), title=title))


def _bar(gpu: JsonMap, leases: list[JsonMap]) -> Text:
    capacity = gpu["capacity_bytes"]
    bar = Text("GPU  ")
    cells = 0
    for lease in leases:
        if lease["charge_bytes"]:
            width = round(BAR_CELLS * lease["charge_bytes"] / capacity)
            bar.append("█" * width, style=COLOURS.get(lease["consumer"], "white"))
            cells += width
    bar.append("░" * max(0, BAR_CELLS - cells))
    used = gpu["measured_used_bytes"]
    bar.append(
        f"  measured {'unknown' if used is None else format_bytes(used)} of "
        f"{format_bytes(capacity)}"
    )
    return bar


def _table(leases: list[JsonMap]) -> Table:
    table = Table("consumer", "state", "charged", "uses", "since", expand=False)
    for lease in leases:
        table.add_row(
            Text(printable(lease["consumer"]), style=COLOURS.get(lease["consumer"], "white")),
            Text(printable(lease["state"])),
            format_bytes(lease["charge_bytes"]), str(lease["uses"]), f"{lease['since_s']:.0f} s",
        )  # fmt: skip
    return table
