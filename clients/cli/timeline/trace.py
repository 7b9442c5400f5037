"""A story in the Trace Event Format, for Perfetto (ui.perfetto.dev) and chrome://tracing.

Each GPU is a process: counters of charged and measured bytes, and a thread for each lease lane with
its states and, inside them, the phases of its eviction. Uses and waits may overlap: they are
asynchronous events. Times are microseconds since the story's beginning.
"""

import time
from collections.abc import Iterable

from vram_arbiter.clients.cli.timeline.story import GpuStory, LeaseStory, Span, Story
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.printable import printable

WAITING_PID = 1
"""Process of what is on no GPU: waits, leases that are away, and moments."""
_LEAVING = frozenset({"revoking", "unloading", "verifying"})


def trace(story: Story) -> JsonObject:
    """Return the file's object. Events are in the order of their times."""
    maker = _Maker(story)
    events = sorted(maker.events(), key=lambda event: event["ts"])
    return {
        "traceEvents": [*maker.metadata(), *events],
        "displayTimeUnit": "ms",
        "otherData": {
            "program": "vramctl timeline",
            "began": time.strftime("%Y-%m-%dT%H:%M:%S%z", time.localtime(story.begin_s)),
            "began_wall_s": story.begin_s,
            "notices": list(story.notices),
        },
    }


class _Maker:
    def __init__(self, story: Story) -> None:
        self._story = story
        self._pids = {gpu.gpu: WAITING_PID + 1 + at for at, gpu in enumerate(story.gpus)}
        self._tids: dict[tuple[int, str], int] = {}
        self._evictions = story.evictions_by_lease()
        self._serial = 0

    def metadata(self) -> Iterable[JsonObject]:
        """Name processes and threads. To be called after `events`."""
        titles = {WAITING_PID: "waits and moments"}
        titles |= {self._pids[gpu.gpu]: gpu.title for gpu in self._story.gpus}
        for pid, title in titles.items():
            yield self._meta("process_name", pid, 0, {"name": printable(title)})
            yield self._meta("process_sort_index", pid, 0, {"sort_index": pid})
        for (pid, name), tid in self._tids.items():
            yield self._meta("thread_name", pid, tid, {"name": name})

    def events(self) -> list[JsonObject]:
        found: list[JsonObject] = []
        for gpu in self._story.gpus:
            found += self._counters(gpu)
            pid = self._pids[gpu.gpu]
            for span in gpu.pressure:
                found.append(self._slice(span, pid, self._tid(pid, "pressure"), "pressure", {}))
        for lease in self._story.leases:
            found += self._of_lease(lease)
        for mark in self._story.marks:
            pid = self._pids.get(mark.gpu or "", WAITING_PID)
            found.append(
                {
                    "ph": "i", "s": "p", "name": printable(mark.text), "cat": mark.kind,
                    "ts": self._ts(mark.at_s), "pid": pid, "tid": self._tid(pid, "moments"),
                }
            )  # fmt: skip
        return found

    def _counters(self, gpu: GpuStory) -> Iterable[JsonObject]:
        """Yield the bytes of every name at each change, and what was measured."""
        pid, bytes_by_name = self._pids[gpu.gpu], self._story.bytes_by_name(gpu)
        what = "bytes of processes" if gpu.held else "charged bytes"
        now = {printable(name): 0 for name in bytes_by_name}
        changes = sorted(
            (at, printable(name), count)
            for name, points in bytes_by_name.items()
            for at, count in points
        )
        for place, (at, name, count) in enumerate(changes):
            now[name] = count
            if place + 1 == len(changes) or changes[place + 1][0] != at:
                yield self._counter(what, pid, at, dict(now))
        for at, used in gpu.measured:
            yield self._counter("measured bytes", pid, at, {"in use": used})

    def _counter(self, name: str, pid: int, at_s: float, values: dict[str, int]) -> JsonObject:
        return {
            "ph": "C", "name": name, "cat": "bytes", "ts": self._ts(at_s), "pid": pid, "tid": 0,
            "args": values,
        }  # fmt: skip

    def _of_lease(self, lease: LeaseStory) -> Iterable[JsonObject]:
        args = {"lease": printable(lease.lease_id), "consumer": printable(lease.consumer)}
        pid = self._pids.get(lease.gpu or "", WAITING_PID)
        thread = f"{printable(lease.consumer)} {printable(lease.lease_id)}"
        evictions = self._evictions.get(lease.lease_id, [])
        phases = [phase for one in evictions for phase in one.phases(self._story.end_s)]
        for span in lease.states:
            told = args | ({"why": printable(span.note)} if span.note else {})
            if span.name in ("queued", "standby", "parked"):
                yield from self._overlapping(span, WAITING_PID, lease, span.name, told)
            elif span.name not in _LEAVING or not _during(span, phases):
                yield self._slice(span, pid, self._tid(pid, thread), span.name, told)
        for one in evictions:
            mine = one.phases(self._story.end_s)
            tid = self._tid(pid, thread)
            whole = Span(mine[0].begin_s, mine[-1].end_s, f"eviction for {one.wanted_by}")
            told = args | {"why": printable(one.reason), "verdict": printable(one.verdict)}
            yield self._slice(whole, pid, tid, "eviction", told)
            for phase in mine:
                yield self._slice(phase, pid, tid, phase.name, args)
        for use in lease.uses:
            yield from self._overlapping(use, pid, lease, "use", args)

    def _slice(self, span: Span, pid: int, tid: int, cat: str, args: JsonObject) -> JsonObject:
        begin = self._ts(span.begin_s)
        return {
            "ph": "X", "name": printable(span.name), "cat": cat, "ts": begin,
            "dur": max(0, self._ts(span.end_s) - begin), "pid": pid, "tid": tid, "args": args,
        }  # fmt: skip

    def _overlapping(
        self, span: Span, pid: int, lease: LeaseStory, cat: str, args: JsonObject
    ) -> Iterable[JsonObject]:
        """Yield the begin and the end of an asynchronous event."""
        self._serial += 1
        name = printable(lease.consumer if span.name == cat else f"{lease.consumer}: {span.name}")
        shared = {"name": name, "cat": cat, "id": self._serial, "pid": pid, "tid": 0}
        yield {"ph": "b", "ts": self._ts(span.begin_s), **shared, "args": args}
        yield {"ph": "e", "ts": max(self._ts(span.begin_s), self._ts(span.end_s)), **shared}

    def _tid(self, pid: int, name: str) -> int:
        return self._tids.setdefault((pid, name), len(self._tids) + 1)

    def _ts(self, at_s: float) -> int:
        begin, end = self._story.begin_s, self._story.end_s
        return round((min(max(at_s, begin), end) - begin) * 1e6)

    def _meta(self, name: str, pid: int, tid: int, args: JsonObject) -> JsonObject:
        return {"ph": "M", "name": name, "ts": 0, "pid": pid, "tid": tid, "args": args}


def _during(span: Span, phases: Iterable[Span]) -> bool:
    phases = list(phases)
    return bool(phases) and any(
        one.begin_s <= span.begin_s and span.end_s <= one.end_s + 1e-6 for one in phases
    )
