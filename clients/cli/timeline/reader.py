"""Events of the history, snapshots of leases and readings of GPUs → a `Story`.

Pure. Charges are those of leases: bytes that a process retains after its lease are not known from
events. Kinds of events that are not known are left out: a newer daemon may tell them.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field

from vram_arbiter.clients.cli.timeline.story import (
    AWAY,
    GpuStory,
    LeaseStory,
    Leaving,
    Mark,
    Span,
    Story,
    within,
)
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.views import LeaseView

_NEXT = {
    "queued": "queued", "granted": "loading", "ready": "held", "revoke_asked": "revoke",
    "revoke_acked": "quiesce", "revoke_withdrawn": "held", "unloading": "unload",
    "released": "verify", "standby": "standby", "parked": "parked",
}  # fmt: skip
"""State after an event of this kind."""
_BEFORE = {
    "ready": "loading", "revoke_acked": "revoke", "revoke_withdrawn": "revoke",
    "verified": "verify", "oom": "loading", "denied": "queued", "cancelled": "queued",
}  # fmt: skip
"""State before an event, for a lease whose beginning is not known; `held` before the others."""
_OF_VIEW = {"revoking": "revoke", "unloading": "unload", "verifying": "verify"}
_ENDS = frozenset({"denied", "cancelled"})
_LOSSES = frozenset({"lost", "expired"})
MARKED = _LOSSES | {
    "oom", "denied", "deadline_passed", "signalled", "stowaway", "probe_failed", "started",
    "stopped", "operator", "resumed", "journal_failed",
}  # fmt: skip
"""Kinds of events that are drawn as a moment."""


@dataclass(slots=True)
class _Open:
    """A lease while it is read."""

    story: LeaseStory
    state: str
    since_s: float
    note: str = ""
    running: dict[str, tuple[float, str]] = field(default_factory=dict)
    eviction: Leaving | None = None
    ended: bool = False


class Reader:
    """Reads events in their order. `begin_s`: what began before it, begins there."""

    def __init__(self, begin_s: float) -> None:
        self._begin_s = begin_s
        self._last_s = begin_s
        self._leases: dict[str, _Open] = {}
        self._evictions: list[Leaving] = []
        self._gpus: dict[str, GpuStory] = {}
        self._pressed: dict[str, tuple[float, str]] = {}
        self.marks: list[Mark] = []

    # -- in
    def gpu(self, gpu: str, title: str = "", capacity: int = 0, reserve: int = 0) -> GpuStory:
        """Return a GPU, which is added at first sight."""
        return self._gpus.setdefault(gpu, GpuStory(gpu, title or gpu, capacity, reserve))

    def snapshot(self, at_s: float, leases: Iterable[LeaseView]) -> None:
        """Add the leases as they are at a moment. One that is not among them is over."""
        seen = set()
        for view in leases:
            seen.add(view.lease_id)
            state = _OF_VIEW.get(view.state, view.state)
            known = self._leases.get(view.lease_id)
            if known is None or known.ended:
                since = view.granted_s if view.granted_s is not None else view.since_s
                begin = max(self._begin_s, at_s - max(since, view.since_s))
                known = self._add(view.lease_id, view.consumer, view.gpu, state, begin)
            if (known.state, state) != ("quiesce", "revoke"):
                self._move(known, state, max(at_s - view.since_s, known.since_s))
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
            self.marks.append(Mark(at_s, kind, told, event.get("gpu")))
        if kind == "pressure":
            self._pressure(at_s, event)
        elif event.get("lease_id") and kind not in ("operator", "switch"):
            self._of_lease(self._known(at_s, kind, event), at_s, kind, event)

    # -- one lease
    def _known(self, at_s: float, kind: str, event: JsonMap) -> _Open:
        """Return the lease of an event; one that is not known has begun before the range."""
        lease_id, gpu = str(event["lease_id"]), event.get("gpu")
        known = self._leases.get(lease_id)
        begins = kind in ("queued", "granted")
        if known is None:
            state = _NEXT[kind] if begins else event.get("was") or _BEFORE.get(kind, "held")
            state = _OF_VIEW.get(str(state), str(state))
            begin = at_s if begins else self._begin_s
            known = self._add(lease_id, str(event.get("consumer", "")), gpu, state, begin)
        elif known.ended and (begins or kind in AWAY):
            known.ended, known.state, known.since_s, known.note = False, _NEXT[kind], at_s, ""
        if gpu is not None and not known.ended:
            known.story.gpu = str(gpu)
        return known

    def _of_lease(self, lease: _Open, at_s: float, kind: str, event: JsonMap) -> None:
        if lease.ended:
            return
        self._use(lease, at_s, kind, event)
        self._eviction(lease, at_s, kind, event)
        charge = event.get("charge_bytes")
        if kind in ("granted", "ready") and isinstance(charge, int):
            lease.story.charges.append((at_s, charge))
        if kind == "reattached":
            state = str(event.get("state", lease.state))
            self._move(lease, _OF_VIEW.get(state, state), at_s)
        elif kind == "verified" and event.get("resolved"):
            lease.story.charges.append((at_s, 0))
            if lease.state not in AWAY:
                self._end(lease, at_s)
        elif kind in _ENDS or (kind in _LOSSES and lease.state in AWAY):
            self._end(lease, at_s)
        elif kind in _LOSSES:
            self._move(lease, "verify", at_s)
        elif kind in _NEXT and (kind != "revoke_acked" or lease.state == "revoke"):
            self._move(lease, _NEXT[kind], at_s, str(event.get("reason") or ""))

    def _add(self, lease_id: str, consumer: str, gpu: object, state: str, since_s: float) -> _Open:
        story = LeaseStory(lease_id, consumer, None if gpu is None else str(gpu))
        self._leases[lease_id] = added = _Open(story, state, since_s)
        return added

    def _move(self, lease: _Open, state: str, at_s: float, note: str = "") -> None:
        if state == lease.state:
            lease.note = lease.note or note
            return
        self._close(lease, at_s)
        lease.state, lease.since_s, lease.note = state, at_s, note

    def _close(self, lease: _Open, at_s: float, *, going: bool = False) -> None:
        if at_s > lease.since_s or going:
            span = Span(lease.since_s, max(at_s, lease.since_s), lease.state, lease.note, going)
            lease.story.states.append(span)

    def _end(self, lease: _Open, at_s: float, *, going: bool = False) -> None:
        """End a lease; `going`: only its story, at the end of the range."""
        self._close(lease, at_s, going=going)
        for began_s, label in lease.running.values():
            lease.story.uses.append(Span(began_s, at_s, label, going=going))
        lease.running.clear()
        lease.ended = True
        if lease.story.charges and lease.story.charges[-1][1] and not going:
            lease.story.charges.append((at_s, 0))

    def _use(self, lease: _Open, at_s: float, kind: str, event: JsonMap) -> None:
        use_id = str(event.get("use_id", ""))
        label = str(event.get("label") or "use")
        if kind == "use_began":
            lease.running[use_id] = (at_s, label)
        elif kind == "use_ended":
            since = max(self._begin_s, at_s - float(event.get("ms") or 0.0) / 1e3)
            began_s, label = lease.running.pop(use_id, (since, label))
            lease.story.uses.append(Span(began_s, at_s, label))

    # -- evictions, pressure
    def _eviction(self, lease: _Open, at_s: float, kind: str, event: JsonMap) -> None:
        told, eviction = lease.story, lease.eviction
        if kind == "revoke_asked":
            by, reason = str(event.get("wanted_by") or ""), str(event.get("reason") or "")
            made = Leaving(told.lease_id, told.consumer, told.gpu, by, reason, at_s)
            self._evictions.append(made)
            lease.eviction = made
        elif eviction is not None and kind in ("revoke_withdrawn", "verified"):
            eviction.verdict = str(event.get("verdict") or "withdrawn")
            if kind == "revoke_withdrawn" or event.get("resolved"):
                eviction.end_s, lease.eviction = at_s, None

    def _pressure(self, at_s: float, event: JsonMap) -> None:
        gpu, over = str(event.get("gpu")), int(event.get("pressure_bytes") or 0)
        began = self._pressed.pop(gpu, None)
        if began is not None:
            self.gpu(gpu).pressure.append(Span(began[0], at_s, "pressure", began[1]))
        if over:
            self._pressed[gpu] = (at_s, f"{over} bytes more than the budget")

    # -- out
    def story(
        self, end_s: float, notices: Sequence[str] = (), begin_s: float | None = None
    ) -> Story:
        """Return the story from `begin_s`, or from its first moment after that, to `end_s`. What
        still goes on ends there."""
        for lease in self._leases.values():
            if not lease.ended:
                self._end(lease, end_s, going=True)
            if lease.story.gpu is not None and lease.story.charges:
                self.gpu(lease.story.gpu)
        for gpu, (began_s, note) in self._pressed.items():
            self.gpu(gpu).pressure.append(Span(began_s, end_s, "pressure", note, going=True))
        story = Story(
            self._begin_s,
            end_s,
            tuple(self._gpus.values()),
            tuple(lease.story for lease in self._leases.values()),
            tuple(self._evictions),
            tuple(self.marks),
            tuple(notices),
        )
        begin = self._begin_s if begin_s is None else begin_s
        return within(story, max(begin, story.first_s), end_s)
