"""Screen and keys of `vramctl top`, on Textual."""

import time
from typing import ClassVar

from rich.text import Text
from textual.app import App, ComposeResult
from textual.binding import Binding, BindingType
from textual.events import Resize
from textual.widgets import Static

from vram_arbiter.clients.cli.text import duration, plural
from vram_arbiter.clients.cli.top import gpus
from vram_arbiter.clients.cli.top.dialogs import Confirm
from vram_arbiter.clients.cli.top.feed import Feed, Order
from vram_arbiter.clients.cli.top.gpus import Samples
from vram_arbiter.clients.cli.top.leases import Leases
from vram_arbiter.clients.cli.top.rows import ORDERS, Row, Table, fitted, rows_of
from vram_arbiter.schemas.runtime.printable import printable

TICK_S = 1.0
"""Between two redraws without news: ages are shown in seconds."""
SAID_S = 8.0
"""For so long the outcome of an order is shown in the last line."""


class Top(App[None]):
    """The live view. Orders need a confirmation."""

    CSS = """
    Screen { layout: vertical; }
    #head, #gpus, #titles, #demands, #selected, #events, #keys { height: auto; }
    #titles { text-style: bold underline; }
    #demands, #selected, #events { border-top: solid $panel; }
    #selected { max-height: 50%; }
    Leases { height: 1fr; min-height: 3; scrollbar-size-vertical: 1; overflow-x: hidden; }
    """
    ENABLE_COMMAND_PALETTE = False
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("q,ctrl+c", "quit", "quit", priority=False),
        Binding("s", "sort", "sort"),
        Binding("e", "evict", "evict"),
        Binding("p", "pin", "pin"),
        Binding("d", "drain", "drain"),
    ]

    def __init__(self, feed: Feed) -> None:
        super().__init__(ansi_color=True)  # the terminal's own colors; none at all with NO_COLOR
        self._feed = feed
        self._order = "queue"
        self._said: tuple[float, str, str] = (0.0, "", "")  # until, what, style

    def compose(self) -> ComposeResult:
        yield Static(id="head")
        yield Static(id="gpus")
        yield Static(id="titles")
        yield Leases()
        yield Static(id="demands")
        yield Static(id="selected")
        yield Static(id="events")
        yield Static(id="keys")

    def on_mount(self) -> None:
        self.query_one(Leases).focus()
        self._feed.changed = self.show
        self.run_worker(self._feed.run(), exit_on_error=True)
        self.set_interval(TICK_S, self.show)
        self.show()

    def on_resize(self, event: Resize) -> None:
        self.call_after_refresh(self.show)

    def on_option_list_option_highlighted(self) -> None:
        self._show_selected()

    # -- drawing
    def show(self) -> None:
        """Draw what the feed knows."""
        if not self.is_running or not self.screen_stack:
            return
        base, feed, width = self.screen_stack[0], self._feed, self.size.width
        status, lost_s = feed.status, feed.lost_s
        base.query_one("#head", Static).update(self._head(lost_s))
        base.query_one("#keys", Static).update(self._keys())
        if status is None:
            return
        samples = [feed.samples.get(gpu.gpu, Samples()) for gpu in status.gpus]
        panel = gpus.panel(status, samples, width, self.size.height)
        base.query_one("#gpus", Static).update(Text("\n".join(panel), no_wrap=True))
        table = Table(width - 1)  # the last column is the scroll bar's
        rows = sorted(rows_of(status), key=ORDERS[self._order])
        base.query_one("#titles", Static).update(Text(table.head(), no_wrap=True))
        base.query_one(Leases).show(rows, table)
        self._show_selected()
        demands = base.query_one("#demands", Static)
        lines = gpus.demands(status, width, self.size.height)
        demands.update(Text("\n".join(lines), no_wrap=True))
        demands.display = bool(lines)
        most = 1 if self.size.height <= 24 else 1 + (self.size.height - 24) // 3
        shown = Text("\n".join(fitted(line, width) for line in list(feed.events)[-most:]))
        base.query_one("#events", Static).update(shown)

    def _head(self, lost_s: float | None) -> Text:
        feed, width = self._feed, self.size.width
        shown = Text(no_wrap=True, overflow="ellipsis")
        if lost_s is not None:
            since = f"the arbiter cannot be reached, since {lost_s:.0f} s"
            shown.append(f"{since}; what it said last:" if width >= 70 else since, "bold red")
        elif feed.status is None:
            shown.append("waiting for the arbiter's first answer")
        else:
            roles = {None: "observer", "": "operator"}
            shown.append(gpus.header(feed.status, roles.get(feed.refusal, "observer"), width))
        for line in [] if feed.status is None else gpus.notices(feed.status):
            shown.append(f"\n{fitted(line, width)}", "bold yellow")
        return shown

    def _show_selected(self) -> None:
        base, status = self.screen_stack[0], self._feed.status
        lines = gpus.selected_lines(base.query_one(Leases).row)
        if not lines and status is not None:
            lines = ["no leases"]
        base.query_one("#selected", Static).update(Text("\n".join(lines)))

    def _keys(self) -> Text:
        until, said, style = self._said
        if time.monotonic() < until:
            return Text(said, style=style)
        shown, wide = Text(no_wrap=True, overflow="ellipsis"), self.size.width >= 70
        drained = self._feed.status is not None and bool(self._feed.status.drained)
        orders = [("e", "evict"), ("p", "pin"), ("d", "resume" if drained else "drain")]
        if self._feed.refusal:
            orders = [("", "e p d: operators only")]
        sort = f"sort {self._order}" if wide else "sort"
        for key, what in [("s", sort), *orders, ("q", "quit")]:
            shown.append(f"{key} " if key else "", "bold").append(f"{what}  ", "" if key else "dim")
        return shown

    def _say(self, said: str, style: str) -> None:
        self._said = (time.monotonic() + SAID_S, said, style)
        self.show()

    # -- keys
    def action_sort(self) -> None:
        names = list(ORDERS)
        self._order = names[(names.index(self._order) + 1) % len(names)]
        self._say(f"sorted by {self._order}", "bold")

    def action_evict(self) -> None:
        if (row := self._selected()) is None:
            return
        if row.lease.state == "queued":
            said = f"{printable(row.lease.consumer)} waits: it has no bytes to evict"
            self._say(said, "bold yellow")
            return
        uses = row.lease.uses
        then = f"It finishes {plural(uses, 'use')} first." if uses else "It is idle."
        self._ask(Order("evict", row.lease.lease_id), f"Evict {_name(row)}? {then}", "Evict")

    def action_pin(self) -> None:
        if (row := self._selected()) is None:
            return
        if row.lease.pinned:
            question = f"Unpin {_name(row)}, pinned by {row.lease.pinned}?"
            self._ask(Order("unpin", row.lease.lease_id), question, "Unpin")
        else:
            question = f"Pin {_name(row)}? It is not evicted until it is unpinned."
            self._ask(Order("pin", row.lease.lease_id), question, "Pin")

    def action_drain(self) -> None:
        status = self._feed.status
        if status is not None and status.drained:
            question = f"Resume? Drained by {status.drained}."
            self._ask(Order("resume"), question, "Resume")
        else:
            question = "Drain? Nothing new is granted until it is resumed; holders keep theirs."
            self._ask(Order("drain"), question, "Drain")

    def _selected(self) -> Row | None:
        row = self.query_one(Leases).row
        if row is None:
            self._say("no lease is selected", "bold yellow")
        return row

    def _ask(self, order: Order, question: str, yes: str) -> None:
        """Ask for a confirmation. One that is not allowed to operate is told so by the arbiter."""
        if self._feed.refusal:
            self._say(self._feed.refusal, "bold red")
            return

        def answered(reason: str | None) -> None:
            if reason is None:
                self._say(f"not done: {order.action}", "bold")
            else:
                self.run_worker(self._send(Order(order.action, order.target, reason)))

        self.push_screen(Confirm(printable(question), yes), answered)

    async def _send(self, order: Order) -> None:
        self._say(f"{order.action}: sent", "bold")
        done, said = await self._feed.order(order)
        self._say(said, "bold green" if done else "bold red")


def _name(row: Row) -> str:
    since = duration(row.since_s)
    return f"{row.lease.consumer} ({row.lease.lease_id}), {row.lease.state} for {since}"
