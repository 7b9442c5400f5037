"""Return of an evicted model: its lease is parked or on standby, and a request calls it back.

A lease on standby returns by itself when there is room; called back it waits like any waiter.
Must not load or unload: the lease's `restore` does.
"""

import asyncio
import logging
import time
from typing import Final

from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.errors import BadState, Loading, VramError, WaitTimeout
from vram_arbiter.sidecars.gpu_copy import GpuCopy
from vram_arbiter.sidecars.host_copy import HostCopy

AWAY: Final = ("standby", "parked")
"""States of a lease without bytes that is not over."""
_LEAVING: Final = ("revoking", "unloading")
_log = logging.getLogger("sidecars")


class Recall:
    """Calls the lease of `name` back, once for all requests that wait for it."""

    def __init__(self, name: str, host: HostCopy, gpu: GpuCopy) -> None:
        self._name, self._host, self._gpu = name, host, gpu
        self._calling: asyncio.Task[VramError | None] | None = None

    @property
    def under_way(self) -> bool:
        return self._calling is not None and not self._calling.done()

    async def until_held(self, lease: AsyncLease, deadline: float | None) -> bool:
        """Follow a leaving lease until it is resident again, calling it back from standby.

        Returns False if it ended, its bytes unloaded. Raises Loading or WaitTimeout when the time
        is over, or the arbiter's refusal. A wait that ends so goes on in the background: the model
        was wanted, and returns as soon as it may.
        """
        while (seen := lease.state) not in ("held", "gone"):
            if seen == "loading":  # its `restore` loads, without a limit
                await lease.wait_change(seen)
                continue
            try:
                async with asyncio.timeout(left_s(deadline)):
                    if seen not in AWAY:
                        await lease.wait_change(seen)
                    elif (refused := await asyncio.shield(self._called_back(lease))) is not None:
                        raise refused
            except TimeoutError:
                if lease.state in AWAY:
                    raise WaitTimeout(
                        f"{self._name} is evicted ({lease.state}), and there was no room for it "
                        "in time",
                        hint=f"`vramctl why {self._name}` names the holder; it returns as soon as "
                        "it may",
                    ) from None
                if lease.state in _LEAVING:
                    raise still(self._name, lease.state) from None
        if lease.state == "held":
            return True
        await self.until_left(lease, deadline)
        return False

    async def until_left(self, lease: AsyncLease, deadline: float | None) -> None:
        """Wait until a lease that is leaving has left, its bytes unloaded.

        Raises Loading when the time is over.
        """
        try:
            async with asyncio.timeout(left_s(deadline)):
                while (leaving := lease.state) in _LEAVING:
                    await lease.wait_change(leaving)
                if lease.state == "gone":
                    await lease.wait_gone()
        except TimeoutError:
            raise still(self._name, self._gpu.state) from None

    def _called_back(self, lease: AsyncLease) -> asyncio.Task[VramError | None]:
        """Ask for the lease as a waiter, without a limit: a request's own is shorter than a goal
        may be."""
        if self._calling is None or self._calling.done():
            self._calling = asyncio.create_task(self._call_back(lease), name="call back")
        return self._calling

    async def _call_back(self, lease: AsyncLease) -> VramError | None:
        """Wait until the lease is granted again or over.

        Returns the reason why the arbiter refuses even the wait.
        """
        away = lease.state
        _log.info("requested: calling the lease back from %s", away)
        self._host.fetch()
        try:
            await lease.reacquire()
        except BadState:  # it returns by itself in this moment
            await lease.wait_change(away)
        except VramError as error:
            if lease.state in AWAY:
                return error
        return None


def still(name: str, state: str) -> Loading:
    """Return the refusal of a request whose time ended before the model had left or arrived."""
    return Loading(f"{name} is still {state}", hint="ask again, or wait longer")


def left_s(deadline: float | None) -> float | None:
    """Return the seconds until a moment of the monotonic clock; None: no limit."""
    return None if deadline is None else max(0.0, deadline - time.monotonic())
