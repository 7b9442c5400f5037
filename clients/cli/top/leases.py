"""List of leases of `vramctl top`: selection and scrolling."""

from collections.abc import Sequence
from typing import ClassVar

from rich.text import Text
from textual.binding import Binding, BindingType
from textual.widgets import OptionList
from textual.widgets.option_list import Option

from vram_arbiter.clients.cli.top.rows import Row, Table


class Leases(OptionList):
    """Leases, one line each, and a second one for what a waiter waits for."""

    DEFAULT_CSS = """
    Leases { border: none; padding: 0; background: transparent; }
    Leases:focus { border: none; background-tint: transparent; }
    Leases > .option-list--option { padding: 0; }
    Leases > .option-list--option-hover { padding: 0; background: transparent; }
    Leases > .option-list--option-highlighted, Leases:focus > .option-list--option-highlighted {
        color: $foreground; background: transparent; text-style: reverse;
    }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("k", "cursor_up", show=False),
        Binding("j", "cursor_down", show=False),
    ]
    rows: Sequence[Row] = ()

    @property
    def row(self) -> Row | None:
        """The selected row."""
        return None if self.highlighted is None or not self.rows else self.rows[self.highlighted]

    def show(self, rows: Sequence[Row], table: Table) -> None:
        """Replace all rows; the selection stays at its lease, or at its place."""
        chosen, at = self.row, self.highlighted or 0
        before = [row.lease.lease_id for row in self.rows]
        ids = [row.lease.lease_id for row in rows]
        self.rows = rows
        texts = [_text(row, table) for row in rows]
        if ids == before:
            for place, text in enumerate(texts):
                self.replace_option_prompt_at_index(place, text)
            return
        self.clear_options()
        self.add_options([Option(text) for text in texts])
        if ids:
            same = "" if chosen is None else chosen.lease.lease_id
            self.highlighted = ids.index(same) if same in ids else min(at, len(ids) - 1)


def _text(row: Row, table: Table) -> Text:
    shown = Text(table.line(row), style=_style(row), no_wrap=True)
    if reason := table.reason(row):
        shown.append(f"\n{reason}", "yellow")
    return shown


def _style(row: Row) -> str:
    lease = row.lease
    if lease.state in ("revoking", "unloading", "verifying"):
        return "magenta"
    if lease.state == "queued":
        return "bold yellow"
    if lease.state == "loading":
        return "cyan"
    return "green" if lease.uses else ""
