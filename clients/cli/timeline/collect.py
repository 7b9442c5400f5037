"""Events for a timeline: from the daemon's history over its socket, or from an event log.

A lease that was granted before the asked range is found in earlier pages of the history. An event
log is read by the arbiter's own program, which clients never import.
"""

import json
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.clients.cli import history
from vram_arbiter.clients.cli.history import NEVER, Wanted
from vram_arbiter.clients.cli.offline import EVENT_LOG
from vram_arbiter.clients.cli.status import all_pages
from vram_arbiter.clients.cli.timeline.reader import Reader
from vram_arbiter.clients.cli.timeline.story import Story
from vram_arbiter.clients.net.request import checked
from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.defaults import RESERVE_BYTES
from vram_arbiter.schemas.errors import OperatorError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import LeaseView

SIZES = ("granted", "ready")
"""Kinds of events that tell the bytes and the GPU of a lease; of earlier times no others count."""


class EmptyTimeline(OperatorError):
    """Nothing happened in the range that was asked for."""

    code = "empty_timeline"


class HistoryUnreadable(OperatorError):
    """The daemon cannot read its own history now."""

    code = "history_unreadable"


class BadEventLog(OperatorError):
    """An event log that cannot be read; the message says which file and line."""

    code = "bad_log"


@dataclass(frozen=True, slots=True)
class Range:
    """Which part of the events: since a wall time, or the last seconds before their end."""

    since_wall_s: float | None = None
    last_s: float | None = None

    def begin_s(self, end_s: float, first_s: float) -> float:
        """Return where it begins; with neither, at the first event."""
        if self.since_wall_s is not None:
            return self.since_wall_s
        return first_s if self.last_s is None else end_s - self.last_s


def from_history(wanted: Range, endpoint: str | None) -> Story:
    """Read the history of a running daemon. Raises EmptyTimeline, ArbiterUnreachable, and what the
    arbiter refuses."""
    begin = wanted.begin_s(time.time(), 0.0)
    events = _events(Wanted(since_wall_s=begin, limit=NEVER), endpoint)
    status = from_map(StatusReply, checked(all_pages(endpoint)))
    end = time.time()
    earlier = _earlier(events, status.leases, begin, endpoint)
    if not events and not status.leases:
        since = time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(begin))
        raise EmptyTimeline(
            f"nothing happened since {since}, and no lease is held",
            hint="choose a longer time with --last or --since",
        )
    reader = Reader(begin)
    for gpu in status.gpus:
        title = f"GPU {gpu.index} {gpu.name}"
        drawn = reader.gpu(gpu.gpu, title, gpu.capacity_bytes, gpu.reserve_bytes)
        if gpu.measured_used_bytes is not None:
            drawn.measured.append((end - (gpu.sample_age_s or 0.0), gpu.measured_used_bytes))
    for event in [*earlier, *events]:
        reader.event(event)
    reader.snapshot(end, status.leases)
    return reader.story(end, status.problems)


def _earlier(
    events: Sequence[JsonMap],
    leases: Sequence[LeaseView],
    begin_s: float,
    endpoint: str | None,
) -> list[JsonMap]:
    """Return events before the range that tell the size of leases whose grant is not in it."""
    begun = {one["lease_id"] for one in events if one["kind"] in ("queued", "granted")}
    told = {one["lease_id"] for one in events if one.get("lease_id")}
    unknown = (told | {lease.lease_id for lease in leases}) - begun
    if not unknown:
        return []
    found = _events(Wanted(SIZES, limit=NEVER), endpoint)
    return [one for one in found if one["lease_id"] in unknown and one["at_wall_s"] <= begin_s]


def _events(wanted: Wanted, endpoint: str | None) -> Sequence[JsonMap]:
    """Return all events that are wanted."""
    found: Sequence[JsonMap] = _readable(history.collect(wanted, endpoint))["events"]
    return found


def _readable(reply: Message) -> Message:
    """Raise the arbiter's error, or a history that cannot be read, as an error."""
    if checked(reply).get("problem"):
        raise HistoryUnreadable(reply["problem"], hint="look at the daemon's log and its disk")
    return reply


# -- event log
def from_log(log: Path, wanted: Range) -> Story:
    """Read an event log. Raises BadEventLog for one that is damaged, EmptyTimeline for one without
    events, and for a range outside it."""
    told = read_log(log)
    try:
        return story_of(told, wanted)
    except (KeyError, TypeError, ValueError) as error:
        raise _unread(log, f"{type(error).__name__}: {error}") from error


def read_log(log: Path) -> JsonMap:
    """Have the arbiter's program read a log. Raises BadEventLog."""
    command = [sys.executable, "-m", EVENT_LOG, "story", "--json", str(log)]
    done = subprocess.run(command, stdout=subprocess.PIPE, text=True)
    try:
        told: Message = json.loads(done.stdout)
    except ValueError as error:
        raise _unread(log, f"the reader ended with {done.returncode}") from error
    if "error" in told:
        raise BadEventLog(told["error"]["message"], hint=told["error"]["hint"])
    return told


def _unread(log: Path, problem: str) -> BadEventLog:
    hint = "`vramctl replay` says what is wrong with it"
    return BadEventLog(f"{log} cannot be read: {problem}", hint=hint)


def story_of(told: JsonMap, wanted: Range) -> Story:
    """Make the story of what `read_log` returned. Raises EmptyTimeline."""
    events, end = told["events"], float(told["end_wall_s"])
    if not events and not any(snapshot["leases"] for snapshot in told["snapshots"]):
        raise EmptyTimeline("the event log holds no events", hint="give the log of a longer run")
    begin = max(wanted.begin_s(end, told["begin_wall_s"]), told["begin_wall_s"])
    if begin >= end:
        raise EmptyTimeline(
            f"the event log ends at {time.strftime('%Y-%m-%d %H:%M:%S', time.localtime(end))}",
            hint="choose an earlier time with --since, or use --last",
        )
    reader = Reader(told["begin_wall_s"])
    for gpu in told["gpus"]:
        title, kept = f"GPU {gpu['index']} {gpu['name']}", gpu.get("reserve_bytes", RESERVE_BYTES)
        reader.gpu(gpu["id"], title, gpu["capacity_bytes"], kept)
    for at_s, name, used in told["readings"]:
        reader.gpu(name).measured.append((at_s, used))
    feed = [(one["at_wall_s"], 1, one) for one in events]
    feed += [(one["at_wall_s"], 0, one) for one in told["snapshots"]]
    for at_s, is_event, one in sorted(feed, key=lambda entry: entry[:2]):
        if is_event:
            reader.event(one)
        else:
            reader.snapshot(at_s, [from_map(LeaseView, lease) for lease in one["leases"]])
    return reader.story(end, told["notices"], begin)
