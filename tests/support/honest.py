"""An honest client beside hostile ones: it holds a lease in use, and measures what the others leave
behind in the daemon."""

import os
import time
from pathlib import Path
from typing import Any

from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas.defaults import GIB

MEMORY_SLACK_KIB = 64 * 1024
DESCRIPTOR_SLACK = 8


class Honest:
    """A client with a pinned lease in use. `client` has not said hello yet; the caller
    closes it."""

    def __init__(self, arbiter: ArbiterProcess, client: WireClient) -> None:
        self.arbiter = arbiter
        self.client = client.hello("honest")
        reply = self.client.acquire("honest", GIB, evictable=False, ttl_s=300.0)
        lease = (
            reply["lease"] if reply["state"] == "loading" else self.client.push("granted")["lease"]
        )
        self.on = {"lease_id": lease["lease_id"], "token": lease["token"]}
        assert self.client.ask("ready", **self.on)["ok"]
        assert self.client.ask("use_begin", **self.on, use_id="work")["ok"]
        self.descriptors = self._descriptors()
        self.memory_kib = self.memory_kib_now()

    def _descriptors(self) -> int:
        return len(os.listdir(f"/proc/{self.arbiter.pid}/fd"))

    def memory_kib_now(self) -> int:
        status = Path(f"/proc/{self.arbiter.pid}/status").read_text()
        return int(
            next(line for line in status.splitlines() if line.startswith("VmRSS")).split()[1]
        )

    def is_served(self) -> None:
        """Answered, and its lease as it was."""
        status = self.client.ask("status")
        (mine,) = (lease for lease in status["leases"] if lease["consumer"] == "honest")
        assert (mine["state"], mine["token"], mine["uses"]) == ("held", self.on["token"], 1)
        assert self.client.ask("renew", leases=[self.on])["alive"] == [self.on["lease_id"]]

    def is_alone(self) -> None:
        """Every other client is gone without a trace. The death of a process is heard, and what it
        leaves is closed, a little later."""
        with WireClient(self.arbiter.endpoint) as late:  # accepted behind every earlier connection
            assert late.hello("late", role="observer").ask("bye")["ok"]
        deadline = time.monotonic() + PATIENCE_S
        while trace := self._trace_of_others():
            assert time.monotonic() < deadline, trace
            self.client.receive(0.05)
        self.is_served()

    def _trace_of_others(self) -> dict[str, Any]:
        """What is more than before they came; empty: nothing. All of it at one time."""
        status = self.client.ask("status")
        (mine,) = (lease for lease in status["leases"] if lease["consumer"] == "honest")
        descriptors, memory_kib = self._descriptors(), self.memory_kib_now()
        found = {
            "clients": status["clients"] - 1,
            "leases": len(status["leases"]) - 1,
            "uses": mine["uses"] - 1,
            "descriptors": max(0, descriptors - self.descriptors - DESCRIPTOR_SLACK),
            "memory_kib": max(0, memory_kib - self.memory_kib - MEMORY_SLACK_KIB),
        }
        return {what: more for what, more in found.items() if more}
