"""List of leases of `vramctl top`: selection, scrolling, and only the visible lines drawn."""

from collections.abc import Sequence
from typing import ClassVar

from rich.text import Text
from textual.binding import Binding, BindingType
from textual.events import Click
from textual.geometry import Region, Size
from textual.message import Message
from textual.scroll_view import ScrollView
from textual.strip import Strip

from vram_arbiter.clients.cli.top.rows import Row, Table

type Line = tuple[str, str, Row]
"""A line of the list: text, style, and its lease."""


class Leases(ScrollView, can_focus=True):
    """Leases, one line each, and a second one for what a waiter waits for. Draws only the lines
    that are visible."""

    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("up,k", "move(-1)", "up", show=False),
        Binding("down,j", "move(1)", "down", show=False),
        Binding("pageup", "page(-1)", "page up", show=False),
        Binding("pagedown", "page(1)", "page down", show=False),
        Binding("home", "move(-1000000)", "first", show=False),
        Binding("end", "move(1000000)", "last", show=False),
    ]

    class Moved(Message):
        """Another lease is selected."""

    def __init__(self) -> None:
        super().__init__()
        self._lines: list[Line] = []
        self._rows: list[Row] = []
        self._chosen = ""  # lease id

    @property
    def row(self) -> Row | None:
        """The selected row."""
        at = self._place()
        return None if at is None else self._rows[at]

    def show(self, rows: Sequence[Row], table: Table) -> None:
        """Replace all rows; the selection stays at its lease, or at its place."""
        before = self._place() or 0
        self._rows, self._lines = list(rows), []
        if self._place() is None and rows:
            self._chosen = rows[min(before, len(rows) - 1)].lease.lease_id
        for row in rows:
            self._lines.append((table.line(row), _style(row), row))
            if reason := table.reason(row):
                self._lines.append((reason, "yellow", row))
        self.virtual_size = Size(table.width, len(self._lines))
        self.refresh()

    def render_line(self, y: int) -> Strip:
        at = self.scroll_offset.y + y
        width = self.size.width
        if at >= len(self._lines):
            return Strip.blank(width, self.rich_style)
        text, style, row = self._lines[at]
        chosen = row.lease.lease_id == self._chosen
        shown = Text(text, style=f"{style} reverse" if chosen else style, no_wrap=True)
        segments = shown.render(self.app.console)
        filler = shown.get_style_at_offset(self.app.console, 0) if chosen else None
        strip = Strip(segments).adjust_cell_length(width, filler)
        return strip.apply_style(self.rich_style)

    def action_move(self, by: int) -> None:
        at = self._place()
        if at is not None:
            self._choose(max(0, min(len(self._rows) - 1, at + by)))

    def action_page(self, by: int) -> None:
        self.action_move(by * max(1, self.size.height - 1))

    def on_click(self, event: Click) -> None:
        at = self.scroll_offset.y + event.y
        if at < len(self._lines):
            self._choose(self._rows.index(self._lines[at][2]))

    def _place(self) -> int | None:
        ids = [row.lease.lease_id for row in self._rows]
        return ids.index(self._chosen) if self._chosen in ids else None

    def _choose(self, at: int) -> None:
        self._chosen = self._rows[at].lease.lease_id
        mine = [y for y, line in enumerate(self._lines) if line[2].lease.lease_id == self._chosen]
        self.scroll_to_region(Region(0, mine[0], self.size.width, len(mine)), animate=False)
        self.refresh()
        self.post_message(self.Moved())


def _style(row: Row) -> str:
    lease = row.lease
    if lease.state in ("revoking", "unloading", "verifying"):
        return "magenta"
    if lease.state == "queued":
        return "bold yellow"
    if lease.state == "loading":
        return "cyan"
    return "green" if lease.uses else ""
