"""Mark of the emergency stop on disk: systemd must not restart a stopped robot into motion.

Written the moment the stop latches, removed when a person ends the program in order. It survives a
crash or a kill. Must not know the robot.
"""

from __future__ import annotations

import logging
from pathlib import Path

from vram_arbiter.schemas.errors import EstopRequested

log = logging.getLogger(__name__)


class EstopMark:
    """`path` is the mark of one robot; its folder exists."""

    def __init__(self, path: Path) -> None:
        self._path = path

    def refuse_if_left(self) -> None:
        """Raise EstopRequested when an earlier run has left the mark."""
        try:
            reason = self._path.read_text(encoding="utf-8", errors="replace").strip()
        except FileNotFoundError:
            return
        raise EstopRequested(
            f"an earlier run ended under its emergency stop, not on request: {reason}",
            hint=f"look at the robot, then delete {self._path}",
            details={"reason": reason},
        )

    def leave(self, reason: str) -> None:
        """Leave the mark. Any thread.

        Never raises: the stop itself must proceed. The first reason stays.
        """
        try:
            with self._path.open("x", encoding="utf-8", errors="replace") as mark:
                mark.write(f"{reason}\n")
        except FileExistsError:
            return
        except OSError as error:
            log.error("the emergency stop is latched in this process only: %s", error)

    def remove(self) -> None:
        try:
            self._path.unlink(missing_ok=True)
        except OSError as error:
            log.error("%s stays: %s", self._path, error)
