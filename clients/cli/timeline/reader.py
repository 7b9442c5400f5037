"""Events of the history, snapshots of leases and readings of GPUs → a `Story`.

Pure. Charges are those of leases: bytes that a process retains after its lease are not known from
events. Kinds of events that are not known are left out: a newer daemon may tell them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from vram_arbiter.clients.cli.timeline.story import (
    EvictionStory,
    GpuStory,
    LeaseStory,
    Mark,
    Span,
    Story,
    within,
)
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.views import LeaseView

RESIDENT = frozenset({"loading", "held", "revoking", "unloading", "verifying"})
"""States in which a lease has bytes on a GPU."""
_NEXT = {
    "queued": "queued",
    "granted": "loading",
    "ready": "held",
    "revoke_asked": "revoking",
    "revoke_withdrawn": "held",
    "unloading": "unloading",
    "released": "verifying",
    "standby": "standby",
    "parked": "parked",
}
"""State after an event of this kind."""
_BEFORE = {
    "ready": "loading",
    "revoke_asked": "held",
    "revoke_acked": "revoking",
    "revoke_withdrawn": "revoking",
    "use_began": "held",
    "use_ended": "held",
    "unloading": "held",
    "verified": "verifying",
    "oom": "loading",
    "drift": "held",
}
"""State before an event, for a lease whose beginning is not known."""
_ENDS = frozenset({"denied", "cancelled"})
_LOSSES = frozenset({"lost", "expired"})
MARKED = frozenset(
    {
        "oom",
        "denied",
        "lost",
        "expired",
        "deadline_passed",
        "signalled",
        "stowaway",
        "probe_failed",
        "started",
        "stopped",
        "operator",
        "resumed",
        "journal_failed",
    }
)
"""Kinds of events that are drawn as a moment."""


def _state_before(kind: str, event: JsonMap) -> str:
    """Return the state of a lease before the first event that is known of it."""
    if kind in _ENDS:
        return "queued"
    return str(event.get("was") or _BEFORE.get(kind, "held"))


@dataclass(slots=True)
class _Open:
    """A lease while it is read."""

    story: LeaseStory
    state: str
    since_s: float
    note: str = ""
    running: dict[str, tuple[float, str]] = field(default_factory=dict)
    ended: bool = False


class Reader:
    """Reads events in their order. `begin_s`: what began before it, begins there."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = begin_s
        self._last_s = begin_s
        self._leases: dict[str, _Open] = {}
        self._evictions: list[EvictionStory] = []
        self._leaving: dict[str, EvictionStory] = {}
        self._gpus: dict[str, GpuStory] = {}
        self._pressed: dict[str, tuple[float, str]] = {}
        self._marks: list[Mark] = []

    # -- in
    def gpu(self, gpu: str, title: str, capacity_bytes: int, reserve_bytes: int) -> GpuStory:
        """Add a GPU that is known."""
        found = self._gpu(gpu)
        found.title, found.capacity_bytes, found.reserve_bytes = (
            title,
            capacity_bytes,
            reserve_bytes,
        )
        return found

    def mark(self, mark: Mark) -> None:
        """Add a moment that no event tells."""
        self._marks.append(mark)

    def reading(self, at_s: float, gpu: str, used_bytes: int) -> None:
        """Add a reading of a GPU."""
        self._gpu(gpu).measured.append((at_s, used_bytes))

    def snapshot(self, at_s: float, leases: Iterable[LeaseView]) -> None:
        """Add the leases as they are at a moment. One that is not among them is over."""
        seen = set()
        for view in leases:
            seen.add(view.lease_id)
            known = self._leases.get(view.lease_id)
            if known is None or known.ended:
                since = view.granted_s if view.granted_s is not None else view.since_s
                begin = max(self._begin_s, at_s - max(since, view.since_s))
                known = self._add(view.lease_id, view.consumer, view.gpu, view.state, begin)
                if view.gpu is not None:
                    known.story.charges.append((begin, view.charge_bytes))
            if known.state != view.state:
                self._move(known, view.state, max(at_s - view.since_s, known.since_s))
            if view.gpu is not None and not known.story.charges:
                known.story.charges.append((known.since_s, view.charge_bytes))
        for lease_id, one in self._leases.items():
            if lease_id not in seen and not one.ended:
                self._end(one, max(one.since_s, min(self._last_s, at_s)))

    def event(self, event: JsonMap) -> None:
        """Add one event of the history."""
        at_s, kind = float(event["at_wall_s"]), str(event["kind"])
        self._last_s = max(self._last_s, at_s)
        if kind in MARKED:
            text = str(event.get("reason") or event.get("action") or "")
            who = str(event.get("consumer") or event.get("name") or event.get("action") or "")
            told = f"{kind.replace('_', ' ')} {who}".strip() + (f": {text}" if text else "")
            self._marks.append(Mark(at_s, kind, told, event.get("gpu")))
        if kind == "pressure":
            self._pressure(at_s, event)
        lease_id = event.get("lease_id")
        if lease_id and kind not in ("operator", "switch"):
            self._of_lease(str(lease_id), at_s, kind, event)
        if kind == "switch":
            self._sizes_of_evicted(event)

    # -- one lease
    def _of_lease(self, lease_id: str, at_s: float, kind: str, event: JsonMap) -> None:
        known, gpu = self._leases.get(lease_id), event.get("gpu")
        if known is None:
            begins = kind in ("queued", "granted")
            state = _NEXT[kind] if begins else _state_before(kind, event)
            begin = at_s if begins else self._begin_s
            known = self._add(lease_id, str(event.get("consumer", "")), gpu, state, begin)
        elif known.ended and kind in ("queued", "granted", "standby", "parked"):
            known.ended, known.state, known.since_s, known.note = False, _NEXT[kind], at_s, ""
        elif known.ended:
            return
        if gpu is not None:
            known.story.gpu = str(gpu)
        self._use(known, at_s, kind, event)
        self._eviction(known, at_s, kind, event)
        charge = event.get("charge_bytes")
        if kind in ("granted", "ready") and isinstance(charge, int):
            known.story.charges.append((at_s, charge))
        if kind == "reattached":
            self._move(known, str(event.get("state", known.state)), at_s)
        elif kind == "verified" and event.get("resolved"):
            self._freed(known, at_s)
        elif kind in _ENDS:
            self._end(known, at_s)
        elif kind in _LOSSES:
            if known.state in RESIDENT:
                self._move(known, "verifying", at_s)
            else:
                self._end(known, at_s)
        elif kind in _NEXT:
            self._move(known, _NEXT[kind], at_s, str(event.get("reason") or ""))

    def _add(self, lease_id: str, consumer: str, gpu: object, state: str, since_s: float) -> _Open:
        story = LeaseStory(lease_id, consumer, None if gpu is None else str(gpu))
        self._leases[lease_id] = added = _Open(story, state, since_s)
        return added

    def _move(self, lease: _Open, state: str, at_s: float, note: str = "") -> None:
        if state == lease.state:
            lease.note = lease.note or note
            return
        self._close_state(lease, at_s)
        lease.state, lease.since_s, lease.note = state, at_s, note

    def _close_state(self, lease: _Open, at_s: float, *, going: bool = False) -> None:
        if at_s > lease.since_s or going:
            span = Span(lease.since_s, max(at_s, lease.since_s), lease.state, lease.note, going)
            lease.story.states.append(span)

    def _freed(self, lease: _Open, at_s: float) -> None:
        """Note that the bytes of a lease are gone; one that is away lives on."""
        lease.story.charges.append((at_s, 0))
        if lease.state not in ("standby", "parked", "queued") and not lease.ended:
            self._end(lease, at_s)

    def _end(self, lease: _Open, at_s: float) -> None:
        self._close_state(lease, at_s)
        for began_s, label in lease.running.values():
            lease.story.uses.append(Span(began_s, at_s, label))
        lease.running.clear()
        lease.ended = True
        if lease.story.charges and lease.story.charges[-1][1]:
            lease.story.charges.append((at_s, 0))

    def _use(self, lease: _Open, at_s: float, kind: str, event: JsonMap) -> None:
        use_id = str(event.get("use_id", ""))
        label = str(event.get("label") or "use")
        if kind == "use_began":
            lease.running[use_id] = (at_s, label)
        elif kind == "use_ended":
            since = max(self._begin_s, at_s - float(event.get("ms") or 0.0) / 1e3)
            began_s, label = lease.running.pop(use_id, (since, label))
            if kind == "use_ended" or began_s < at_s:
                lease.story.uses.append(Span(began_s, at_s, label))

    # -- evictions, pressure
    def _eviction(self, lease: _Open, at_s: float, kind: str, event: JsonMap) -> None:
        lease_id, told = lease.story.lease_id, lease.story
        if kind == "revoke_asked":
            made = EvictionStory(
                lease_id,
                told.consumer,
                told.gpu,
                str(event.get("wanted_by") or ""),
                str(event.get("reason") or ""),
                at_s,
            )
            self._evictions.append(made)
            self._leaving[lease_id] = made
            return
        leaving = self._leaving.get(lease_id)
        if leaving is None:
            return
        if kind == "revoke_withdrawn":
            leaving.verdict, leaving.withdrawn_s = "withdrawn", at_s
            del self._leaving[lease_id]
        elif kind == "revoke_acked" and leaving.acked_s is None:
            leaving.acked_s = at_s
        elif kind == "unloading":
            leaving.unloading_s = at_s
        elif kind in ("released", *_LOSSES):
            leaving.released_s = at_s
        elif kind == "verified":
            leaving.verdict = str(event.get("verdict") or "")
            if event.get("resolved"):
                leaving.verified_s = at_s
                del self._leaving[lease_id]

    def _sizes_of_evicted(self, event: JsonMap) -> None:
        """A switch names the charges of the leases that left for it: of those whose grant is not
        known."""
        for gone in event.get("evicted", ()):
            known = self._leases.get(str(gone.get("lease_id")))
            charges = None if known is None else known.story.charges
            if charges is not None and charges and not any(count for _, count in charges):
                begin = known.story.states[0].begin_s if known and known.story.states else 0.0
                charges.insert(0, (begin, int(gone.get("charge_bytes") or 0)))

    def _pressure(self, at_s: float, event: JsonMap) -> None:
        gpu, over = str(event.get("gpu")), int(event.get("pressure_bytes") or 0)
        began = self._pressed.pop(gpu, None)
        if began is not None:
            self._gpu(gpu).pressure.append(Span(began[0], at_s, "pressure", began[1]))
        if over:
            self._pressed[gpu] = (at_s, f"{over} bytes more than the budget")

    def _gpu(self, gpu: str) -> GpuStory:
        if gpu not in self._gpus:
            self._gpus[gpu] = GpuStory(gpu, gpu)
        return self._gpus[gpu]

    # -- out
    def story(self, end_s: float, notices: Sequence[str] = ()) -> Story:
        """Return the story up to `end_s`. What still goes on ends there."""
        for lease in self._leases.values():
            if not lease.ended:
                self._close_state(lease, end_s, going=True)
                for began_s, label in lease.running.values():
                    lease.story.uses.append(Span(began_s, end_s, label, going=True))
                lease.running.clear()
            if lease.story.gpu is not None and lease.story.charges:
                self._gpu(lease.story.gpu)
        for gpu, (began_s, note) in self._pressed.items():
            self._gpu(gpu).pressure.append(Span(began_s, end_s, "pressure", note, going=True))
        story = Story(
            self._begin_s,
            end_s,
            tuple(self._gpus.values()),
            tuple(lease.story for lease in self._leases.values()),
            tuple(self._evictions),
            tuple(self._marks),
            tuple(notices),
        )
        return within(story, self._begin_s, end_s)
