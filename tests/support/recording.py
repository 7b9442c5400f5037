"""Event logs without a daemon: of what a `CoreDriver` went through."""

from pathlib import Path

from tests.support.core_driver import START_S, CoreDriver
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.eventlog.logfile import (
    Header,
    engine_id,
    entry_line,
    file_name,
    header_line,
)


def write_log(driver: CoreDriver, folder: Path) -> Path:
    """Everything that the driver posted, as the daemon would have recorded it. Returns the file."""
    header = Header(
        "0", engine_id(), driver.settings.epoch, 0, "start", 0.0, START_S, driver.settings, None
    )
    engine = Arbiter(driver.settings, START_S)
    path = folder / file_name(0.0, driver.settings.epoch, 0)
    with path.open("w") as file:
        file.write(header_line(header))
        for now, event in driver.events:
            file.write(entry_line(now, event, engine.handle(event, now)))
    return path
