"""A socket on which another program follows a program under its lease, and says when it is wanted
(`vramctl run --control FD`).

Lines of JSON. To the other program, at each change: `{"state", "lease_id", "token", "gpu",
"reason"}`, where `state` is `queued` or one of `clients.lease.LeaseState`. From it: `"want"` (come
back; of a service also: start, where it does not run) and `"rest"` (leave, until wanted). The
program ends with the other one.
"""

import asyncio
import json
import socket
from collections.abc import AsyncIterator, Sequence
from typing import Final

LINE_MAX_BYTES: Final = 4096
WANT, REST = "want", "rest"


class Control:
    """The end of `vramctl run`. `wanted` is set while the other program wants the program."""

    def __init__(self, descriptor: int) -> None:
        """Take an open socket. Raises OSError where it is none."""
        self._socket = socket.socket(fileno=descriptor)
        self._writer: asyncio.StreamWriter | None = None
        self._early: list[bytes] = []
        self.wanted = asyncio.Event()

    async def orders(self) -> AsyncIterator[str]:
        """Yield what the other program says, until it has ended."""
        reader, self._writer = await asyncio.open_connection(
            sock=self._socket, limit=LINE_MAX_BYTES
        )
        self._writer.writelines(self._early)
        try:
            while line := await reader.readline():
                yield str(json.loads(line))
        except (OSError, ValueError):  # a line that cannot be read ends the program, too
            return

    def tell(self, state: str, lease_id: str, token: Sequence[int], gpu: str, reason: str) -> None:
        """Report a state. What the other program does not read waits for it."""
        said = {"state": state, "lease_id": lease_id, "token": token, "gpu": gpu, "reason": reason}
        line = json.dumps(said).encode() + b"\n"
        if self._writer is None:
            self._early.append(line)
        elif not self._writer.is_closing():
            self._writer.write(line)
