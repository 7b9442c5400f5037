"""Confirmation of motions by the operator, on the socket or on the terminal.

Sits between loop and tools: a motion waits here until the operator has answered; the loop goes on
hearing results, words and cancels meanwhile. Questions about the scene pass.
"""

import asyncio
import contextlib
import logging
import os
from collections.abc import Iterator
from typing import IO

from vram_arbiter.reasoner.loop import Dispatch, describe
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.schemas.reasoner import Motion
from vram_arbiter.schemas.tools import ExecuteRskill, ToolCall

log = logging.getLogger(__name__)

LINE_MAX_BYTES = 500


class Confirmations:
    """`before(dispatch)` asks before each motion; a motion that is denied is a refused call."""

    def __init__(self) -> None:
        self._asked = 0
        self._answer: asyncio.Future[tuple[bool, str]] | None = None
        self.pending: Motion | None = None
        """The motion that waits. Its number keeps an answer from meeting a later one."""

    def before(self, dispatch: Dispatch) -> Dispatch:
        async def confirmed(call: ToolCall) -> Outcome:
            if isinstance(call, ExecuteRskill):
                yes, reason = await self._ask(call)
                if not yes:
                    why = (
                        f"the operator did not confirm this motion{f': {reason}' if reason else ''}"
                    )
                    return Outcome("refused", why, "not_permitted")
            return await dispatch(call)

        return confirmed

    async def _ask(self, call: ExecuteRskill) -> tuple[bool, str]:
        self._asked += 1
        text = f"{call.tool} {describe(call)}"
        self.pending = {"number": self._asked, "text": text}
        self._answer = asyncio.get_running_loop().create_future()
        log.warning(
            "motion %d waits for a confirmation: %s. `vram-reasoner --confirm` or `--deny REASON`;"
            " on the reasoner's own terminal y, or anything else as the reason to deny it",
            self._asked,
            text,
        )
        try:
            return await self._answer
        finally:
            self.pending = self._answer = None

    def answer(self, number: int, *, yes: bool, reason: str = "") -> None:
        """Let the motion with this number begin, or refuse it. Raises BadState for another one."""
        if self.pending is None or self.pending["number"] != number:
            waits = f"motion {self.pending['number']} waits" if self.pending else "no motion waits"
            raise BadState(
                f"motion {number} does not wait for a confirmation: {waits}",
                hint="ask for the state again",
            )
        if self._answer is not None and not self._answer.done():
            log.info("motion %d is %s", number, "confirmed" if yes else f"denied: {reason}")
            self._answer.set_result((yes, reason))

    @contextlib.contextmanager
    def on_terminal(self, terminal: IO[str] | None) -> Iterator[None]:
        """Within the block a line of the terminal answers the motion that waits; no terminal, no
        answers. A program may be started without standard input.
        """
        if terminal is None or not terminal.isatty():
            yield
            return
        loop = asyncio.get_running_loop()
        loop.add_reader(terminal.fileno(), self._line, terminal)
        try:
            yield
        finally:
            loop.remove_reader(terminal.fileno())

    def _line(self, terminal: IO[str]) -> None:
        line = os.read(terminal.fileno(), LINE_MAX_BYTES)  # a terminal gives one line at a time
        if not line:  # the terminal was closed: the socket is still there
            asyncio.get_running_loop().remove_reader(terminal.fileno())
        elif self.pending is not None:
            said = line.decode(errors="replace").strip()
            yes = said.lower() in ("y", "yes")
            self.answer(self.pending["number"], yes=yes, reason="" if yes else said)
