"""Event logs without a daemon: of what a `CoreDriver` went through, and of a simulated run."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import TextIO

from tests.support.core_driver import START_S, CoreDriver
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect
from vram_arbiter.arbiter.core.events import Event
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.eventlog.logfile import (
    Header,
    engine_id,
    entry_line,
    file_name,
    header_line,
)
from vram_arbiter.arbiter.lab.gpu import START_S as SIMULATED_START_S
from vram_arbiter.arbiter.lab.outcome import Outcome
from vram_arbiter.arbiter.lab.simulator import simulate
from vram_arbiter.arbiter.lab.workload import Workload


def write_log(driver: CoreDriver, folder: Path, *, made_at: float = START_S) -> Path:
    """Everything that the driver posted, as the daemon would have recorded it. Returns the file."""
    header = Header(
        "0", engine_id(), driver.settings.epoch, 0, "start", 0.0, made_at, driver.settings, None
    )
    engine = Arbiter(driver.settings, made_at)
    path = folder / file_name(0.0, driver.settings.epoch, 0)
    with path.open("w") as file:
        file.write(header_line(header))
        for now, event in driver.events:
            file.write(entry_line(now, event, engine.handle(event, now)))
    return path


@dataclass(slots=True)
class Recording:
    """A simulated engine whose every event goes to a log file: what a daemon with these consumers
    would have recorded."""

    engine: Arbiter
    file: TextIO

    def handle(self, event: Event, now: float) -> Sequence[Effect]:
        effects = self.engine.handle(event, now)
        self.file.write(entry_line(now, event, effects))
        return effects

    def next_deadline(self) -> float | None:
        return self.engine.next_deadline()


def record_workload(workload: Workload, settings: Settings, folder: Path) -> tuple[Path, Outcome]:
    """Simulate and record: the log, and what came of it."""
    header = Header(
        "0", engine_id(), settings.epoch, 0, "start", 0.0, SIMULATED_START_S, settings, None
    )
    path = folder / file_name(0.0, settings.epoch, 0)
    with path.open("w") as file:
        file.write(header_line(header))
        recording = Recording(Arbiter(settings, SIMULATED_START_S), file)
        return path, simulate(workload, recording, settings.policy)
