"""A story in the Trace Event Format, for Perfetto (ui.perfetto.dev) and chrome://tracing.

Each GPU is a process: counters of charged and measured bytes, and a thread for each lease with its
states, those of an eviction inside one slice. Uses and waits may overlap: they are asynchronous
events. Times are microseconds since the story's beginning.
"""

import time
from collections.abc import Iterable, Mapping

from vram_arbiter.clients.cli.timeline.story import AWAY, GpuStory, LeaseStory, Span, Story
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.printable import printable

WAITING_PID = 1
"""Process of what is on no GPU: waits, leases that are away, and moments."""


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
        self._serial = 0

    def metadata(self) -> Iterable[JsonObject]:
        """Name processes and threads. To be called after `events`."""
        titles = {WAITING_PID: "waits and moments"}
        titles |= {self._pids[gpu.gpu]: gpu.title for gpu in self._story.gpus}
        for pid, title in titles.items():
            yield self._event("M", "process_name", 0, pid, 0, args={"name": printable(title)})
        for (pid, name), tid in self._tids.items():
            yield self._event("M", "thread_name", 0, pid, tid, args={"name": name})

    def events(self) -> Iterable[JsonObject]:
        for gpu in self._story.gpus:
            yield from self._counters(gpu)
            pid = self._pids[gpu.gpu]
            for span in gpu.pressure:
                yield self._slice(span, pid, "pressure", "pressure", {})
        for lease in self._story.leases:
            yield from self._of_lease(lease)
        for mark in self._story.marks:
            pid = self._pids.get(mark.gpu or "", WAITING_PID)
            tid = self._tid(pid, "moments")
            yield self._event("i", mark.text, self._ts(mark.at_s), pid, tid, s="p", cat=mark.kind)

    def _counters(self, gpu: GpuStory) -> Iterable[JsonObject]:
        """Yield the bytes of every name at each change, and what was measured."""
        pid, what = self._pids[gpu.gpu], "bytes of processes" if gpu.held else "charged bytes"
        for at, values in steps_of(self._story.bytes_by_name(gpu)):
            shown = {printable(name): count for name, count in values.items()}
            yield self._event("C", what, self._ts(at), pid, 0, cat="bytes", args=shown)
        for at, used in gpu.measured:
            shown = {"in use": used}
            yield self._event("C", "measured bytes", self._ts(at), pid, 0, cat="bytes", args=shown)

    def _of_lease(self, lease: LeaseStory) -> Iterable[JsonObject]:
        args = {"lease": printable(lease.lease_id), "consumer": printable(lease.consumer)}
        pid = self._pids.get(lease.gpu or "", WAITING_PID)
        thread = f"{printable(lease.consumer)} {printable(lease.lease_id)}"
        for one in self._story.evictions:
            if one.lease_id == lease.lease_id:
                end_s = self._story.end_s if one.end_s is None else one.end_s
                whole = Span(one.asked_s, end_s, f"eviction for {one.wanted_by}")
                told = args | {"why": printable(one.reason), "verdict": printable(one.verdict)}
                yield self._slice(whole, pid, thread, "eviction", told)
        for span in lease.states:
            told = args | ({"why": printable(span.note)} if span.note else {})
            if span.name in AWAY:
                yield from self._overlapping(span, WAITING_PID, lease, span.name, told)
            else:
                yield self._slice(span, pid, thread, span.name, told)
        for use in lease.uses:
            yield from self._overlapping(use, pid, lease, "use", args)

    def _slice(self, span: Span, pid: int, thread: str, cat: str, args: JsonObject) -> JsonObject:
        begin, tid = self._ts(span.begin_s), self._tid(pid, thread)
        length = max(0, self._ts(span.end_s) - begin)
        return self._event("X", span.name, begin, pid, tid, dur=length, cat=cat, args=args)

    def _overlapping(
        self, span: Span, pid: int, lease: LeaseStory, cat: str, args: JsonObject
    ) -> Iterable[JsonObject]:
        """Yield the begin and the end of an asynchronous event."""
        self._serial += 1
        name = lease.consumer if span.name == cat else f"{lease.consumer}: {span.name}"
        for phase, at_s in (("b", span.begin_s), ("e", max(span.begin_s, span.end_s))):
            told = {"args": args} if phase == "b" else {}
            at = self._ts(at_s)
            yield self._event(phase, name, at, pid, 0, cat=cat, id=self._serial, **told)

    def _event(
        self, phase: str, name: str, at: int, pid: int, tid: int, **more: object
    ) -> JsonObject:
        shared = {"ph": phase, "name": printable(name), "ts": at, "pid": pid, "tid": tid}
        return {**shared, **more}

    def _tid(self, pid: int, name: str) -> int:
        return self._tids.setdefault((pid, name), len(self._tids) + 1)

    def _ts(self, at_s: float) -> int:
        begin, end = self._story.begin_s, self._story.end_s
        return round((min(max(at_s, begin), end) - begin) * 1e6)


def steps_of(
    steps: Mapping[str, Iterable[tuple[float, int]]],
) -> Iterable[tuple[float, dict[str, int]]]:
    """Yield the value of every name at each time at which one of them changes."""
    changes = sorted((at, name, count) for name, points in steps.items() for at, count in points)
    now = dict.fromkeys(steps, 0)
    for place, (at, name, count) in enumerate(changes):
        now[name] = count
        if place + 1 == len(changes) or changes[place + 1][0] != at:
            yield at, dict(now)
