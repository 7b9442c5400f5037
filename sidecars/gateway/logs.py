"""What servers print: the last lines of each, and readers that follow them."""

import asyncio
from collections import deque
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from typing import Final

from vram_arbiter.schemas.runtime.printable import printable_lines

LINES_MAX: Final = 1000
LINE_MAX_BYTES: Final = 4096
TAIL_LINES: Final = 12
BEHIND_MAX_BYTES: Final = 1 << 18
"""Of lines that a reader has not taken yet."""


class Log:
    """The last lines that a server printed."""

    def __init__(self, name: str) -> None:
        self._name = name
        self._lines: deque[str] = deque(maxlen=LINES_MAX)
        self.readers: set[Reader] = set()

    def add(self, line: bytes) -> None:
        text = printable_lines(line[:LINE_MAX_BYTES].decode(errors="replace").rstrip())
        self._lines.append(text)
        for reader in self.readers:
            reader.add(self._named(text))

    def tail(self) -> str:
        return "\n".join(list(self._lines)[-TAIL_LINES:])

    def text(self) -> str:
        """Return all lines, with the server's name before each."""
        return "".join(map(self._named, self._lines))

    def _named(self, line: str) -> str:
        return f"{self._name}: {line}\n"


class Reader:
    """New lines of logs for one client. `late`: it was BEHIND_MAX_BYTES behind, and gets no
    more."""

    def __init__(self) -> None:
        self.late = False
        self._text = bytearray()
        self._more = asyncio.Event()

    def add(self, line: str) -> None:
        data = line.encode()
        self.late = self.late or len(self._text) + len(data) > BEHIND_MAX_BYTES
        if not self.late:
            self._text += data
        self._more.set()

    async def take(self) -> bytes:
        """Wait for lines, and return them."""
        await self._more.wait()
        self._more.clear()
        taken, self._text = bytes(self._text), bytearray()
        return taken


@contextmanager
def following(logs: Iterable[Log]) -> Iterator[Reader]:
    """Yield a reader of what is printed from now on."""
    reader, logs = Reader(), list(logs)
    for log in logs:
        log.readers.add(reader)
    try:
        yield reader
    finally:
        for log in logs:
            log.readers.discard(reader)
