"""The confirmation of an order in `vramctl top`."""

from typing import ClassVar

from rich.text import Text
from textual.app import ComposeResult
from textual.binding import Binding, BindingType
from textual.containers import Horizontal, Vertical
from textual.screen import ModalScreen
from textual.widgets import Button, Input, Static

from vram_arbiter.schemas.defaults import REASON_MAX_CHARS

REASON = "by hand in vramctl top"


class Confirm(ModalScreen[str | None]):
    """Ask before an order is sent. Returns the reason, or None for no."""

    DEFAULT_CSS = """
    Confirm { align: center middle; }
    Confirm > Vertical {
        width: 56; max-width: 96%; height: auto; border: round $warning; padding: 0 1;
        background: $surface;
    }
    Confirm Input { margin: 1 0 0 0; }
    Confirm Horizontal { height: auto; align-horizontal: center; }
    Confirm Button { margin: 0 1; }
    """
    BINDINGS: ClassVar[list[BindingType]] = [
        Binding("escape,n", "no", "no"),
        Binding("y", "yes", "yes"),
        Binding("left,up", "app.focus_previous", show=False),
        Binding("right,down", "app.focus_next", show=False),
    ]

    def __init__(self, question: str, yes: str) -> None:
        super().__init__()
        self._question, self._yes = question, yes

    def compose(self) -> ComposeResult:
        with Vertical():
            yield Static(Text(self._question))
            yield Input(REASON, max_length=REASON_MAX_CHARS, id="reason", compact=True)
            yield Static(Text("The reason is kept in the history with your name.", style="dim"))
            with Horizontal():
                yield Button("No (n)", id="no", compact=True)
                yield Button(f"{self._yes} (y)", variant="warning", id="yes", compact=True)

    def on_mount(self) -> None:
        self.query_one("#no").focus()

    def on_button_pressed(self, event: Button.Pressed) -> None:
        if event.button.id == "yes":
            self.action_yes()
        else:
            self.action_no()

    def on_input_submitted(self) -> None:
        self.query_one("#yes").focus()

    def action_yes(self) -> None:
        reason = self.query_one("#reason", Input).value.strip()
        self.dismiss(reason or REASON)

    def action_no(self) -> None:
        self.dismiss(None)
