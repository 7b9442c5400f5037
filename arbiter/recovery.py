"""Recovery: what the journal remembers of earlier leases, for the engine of this start."""

import logging
import time
from collections.abc import Callable

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.events import Recovered, Tick
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.host.journal import Journal, Opened
from vram_arbiter.arbiter.host.process_watch import ProcessWatch
from vram_arbiter.arbiter.host.records import processes_of, records_of
from vram_arbiter.arbiter.inbox import Inbox
from vram_arbiter.schemas.plain import JsonMap

log = logging.getLogger(__name__)


def try_records(journal: Journal, settings: Settings) -> None:
    """Let an engine that is thrown away read the journal's records; what it cannot read is put
    aside instead of stopping every start."""
    if not journal.opened.records:
        return
    now = time.monotonic()
    try:
        Arbiter(settings, now).handle(Recovered(records_of(journal.opened.records)), now)
    except Exception as error:
        log.exception("the engine cannot read the journal's records")
        journal.put_aside(f"{type(error).__name__}: {error}")


def report(found: Opened, say: Callable[[str, JsonMap], None]) -> None:
    """Tell history and log of a journal that was put aside, or that may lack its last changes."""
    if found.put_aside is not None:
        say("journal_put_aside", {"file": str(found.put_aside), "problem": found.problem})
    if found.doubt:
        say("journal_doubted", {"why": found.doubt})


def recover(found: Opened, inbox: Inbox, watch: ProcessWatch) -> None:
    """Tell the engine what the journal remembers, and watch the processes that it belongs to."""
    if not found.records:
        inbox.post(Tick())  # lets the engine ask for its first readings
        return
    records = records_of(found.records)
    inbox.post(Recovered(records))
    for process in processes_of(records):
        watch.add(process)
