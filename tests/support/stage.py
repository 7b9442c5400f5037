"""One daemon, a simulated GPU of 8 GiB and consumers, for all tests of a file."""

import json
from typing import Any

from tests.support.children import Child, spawn
from tests.support.fakegpu_check import check_log
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from tests.support.wire import WireClient
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.testing.gpu import FakeGpu

CAPACITY = 8 * GIB
LAG_S = 0.15


class Stage:
    """`program`: what its consumers run (`tests.support.children`). A watcher subscribes to the
    events of the present case."""

    def __init__(self, program: str, config: str) -> None:
        self.arbiter = ArbiterProcess(config=config, prepared=True).start()
        self.gpu = FakeGpu(self.arbiter.gpu_folder)
        self.gpu.edit(release_lag_s=LAG_S)
        self.errors = self.arbiter.runtime / "errors.log"
        self._program = program
        self.children: list[Child] = []
        self.watcher = self._subscribed()

    def watch(self) -> WireClient:
        """Return a fresh subscriber: its first events are those from now on."""
        self.watcher.close()
        self.watcher = self._subscribed()
        return self.watcher

    def event(self, kind: str, **facts: Any) -> dict[str, Any]:
        """Wait for an event with these facts."""
        push = self.watcher.push(
            "event",
            PATIENCE_S,
            lambda p: p["event"]["kind"] == kind and facts.items() <= p["event"].items(),
        )
        event: dict[str, Any] = push["event"]
        return event

    def begin(self, name: str, size: int, habits: str) -> Child:
        """Fork a consumer."""
        arguments = (name, str(size), str(self.arbiter.gpu_folder), habits)
        there: Any = {"name": name, "environ": self.arbiter.environ, "errors": self.errors}
        self.children.append(spawn(self._program, *arguments, **there))
        return self.children[-1]

    def used_when(self, name: str) -> int:
        """Return the bytes on the GPU, of all processes, before `name` touched it first."""
        used = 0
        for line in map(json.loads, self._log().splitlines()):
            if line["name"] == name:
                return used
            used = line["used_after"]
        raise AssertionError(f"{name} never touched the GPU")

    def end_case(self) -> None:
        """Kill all consumers, and wait until the daemon has nothing of them."""
        for child in self.children:
            child.close()
        self.children.clear()
        self.gpu.edit(faults={})
        watcher = self.watch()
        while not _clean(watcher.ask("status")):
            watcher.receive(0.02)  # the next event; the GPU is being read meanwhile

    def close(self) -> None:
        """End all, and check the GPU's log."""
        self.watcher.close()
        report = check_log(self._log())
        self.arbiter.close()
        assert not report.problems
        assert report.oom_events == 0
        assert report.peak_bytes <= CAPACITY

    def _log(self) -> str:
        return (self.arbiter.gpu_folder / fakegpu.LOG_FILE).read_text()

    def _subscribed(self) -> WireClient:
        watcher = WireClient(self.arbiter.endpoint).hello("watcher", role="observer")
        assert watcher.ask("subscribe")["ok"]
        return watcher


def _clean(status: dict[str, Any]) -> bool:
    (gpu,) = status["gpus"]
    kept = ("charged_bytes", "stowaway_bytes", "measured_used_bytes")
    return status["phase"] == "serving" and not (status["leases"] or any(gpu[of] for of in kept))
