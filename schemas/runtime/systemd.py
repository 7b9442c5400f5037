"""sd_notify in thirty lines: tells the service manager READY, RELOADING, STATUS, WATCHDOG and
STOPPING over its datagram socket.

No socket (not started by systemd): every call does nothing. Must not know what the program does.
"""

import os
import socket
import time
from collections.abc import Mapping

READY_S = 1.0
"""READY is worth a wait if the manager's queue is full; everything else is dropped then, to never
hold up the loop."""


class Notifier:
    """`NOTIFY_SOCKET` and `WATCHDOG_USEC` of systemd's notification protocol (sd_notify(3))."""

    def __init__(self, environ: Mapping[str, str]) -> None:
        self._address = environ.get("NOTIFY_SOCKET", "")
        if self._address.startswith("@"):
            self._address = "\0" + self._address[1:]  # abstract namespace
        usec, pid = environ.get("WATCHDOG_USEC", ""), environ.get("WATCHDOG_PID", "")
        mine = not pid or pid == str(os.getpid())
        self.watchdog_s: float | None = (
            int(usec) / 1e6 if usec.isdecimal() and int(usec) and mine else None
        )
        """The manager kills the program if it hears nothing for so long; None: no watchdog."""

    def ready(self, status: str) -> None:
        self._send(f"READY=1\nSTATUS={status}\nMAINPID={os.getpid()}", READY_S)

    def reloading(self) -> None:
        """Ended by `ready`. The time lets a manager of type `notify-reload` match the two."""
        self._send(f"RELOADING=1\nMONOTONIC_USEC={time.monotonic_ns() // 1000}", READY_S)

    def status(self, text: str) -> bool:
        """False: the manager's queue is full, and it has to be said again."""
        return self._send(f"STATUS={text}")

    def watchdog(self) -> None:
        self._send("WATCHDOG=1")

    def stopping(self, reason: str) -> None:
        self._send(f"STOPPING=1\nSTATUS={reason}")

    def _send(self, message: str, timeout_s: float = 0.0) -> bool:
        if not self._address:
            return True
        try:
            with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM | socket.SOCK_CLOEXEC) as out:
                out.settimeout(timeout_s)
                out.sendto(message.encode(), self._address)
        except OSError:
            return False  # a manager that does not listen must not stop the program
        return True
