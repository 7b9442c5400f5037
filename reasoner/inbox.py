"""Messages to a running episode that bypass the planner: an operator's text, a cancel, a danger.

Bounded: texts beyond `WORDS_MAX` drop the oldest ones; a cancel or a danger is never dropped.
"""

import asyncio
import logging
from dataclasses import dataclass

log = logging.getLogger(__name__)

WORDS_MAX = 32


@dataclass(frozen=True, slots=True)
class Said:
    """An operator's words for the planner. They start no motion and stop none by themselves."""

    text: str


@dataclass(frozen=True, slots=True)
class Cancel:
    """End the episode: the goal is canceled, the planner is not asked."""

    reason: str


@dataclass(frozen=True, slots=True)
class Danger:
    """Report a danger. `stop` ends the episode; otherwise the planner learns of it at once."""

    text: str
    stop: bool


Message = Said | Cancel | Danger


class Inbox:
    """One reader, any number of writers on the reader's event loop."""

    def __init__(self) -> None:
        self._messages: list[Message] = []
        self._there = asyncio.Event()

    def put(self, message: Message) -> None:
        words = [one for one in self._messages if isinstance(one, Said)]
        if isinstance(message, Said) and len(words) >= WORDS_MAX:
            log.warning("an operator's words were pushed out: %s", words[0].text)
            self._messages.remove(words[0])
        self._messages.append(message)
        self._there.set()

    async def wait(self) -> None:
        """Wait until there is something to take."""
        await self._there.wait()

    def take(self) -> list[Message]:
        """Take everything, cancels and dangers first."""
        taken, self._messages = self._messages, []
        self._there.clear()
        return sorted(taken, key=lambda message: isinstance(message, Said))
