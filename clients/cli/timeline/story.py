"""What happened on the GPUs: leases with their states and bytes, waits, uses, evictions with their
phases, pressure, and single moments. Times are wall seconds. `reader` makes it from events."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

PHASES = ("revoke", "quiesce", "unload", "verify")
"""Of an eviction: until the holder answers, until its uses end, until it released, until its bytes
are measured gone."""


@dataclass(frozen=True, slots=True)
class Span:
    """An interval. `going`: it had not ended at the end of the story."""

    begin_s: float
    end_s: float
    name: str
    note: str = ""
    going: bool = False


@dataclass(frozen=True, slots=True)
class Mark:
    """A moment."""

    at_s: float
    kind: str
    text: str
    gpu: str | None = None


@dataclass(slots=True)
class EvictionStory:
    """A lease that was revoked, and when it passed each step. None: not yet, or not seen."""

    lease_id: str
    consumer: str
    gpu: str | None
    wanted_by: str
    reason: str
    asked_s: float
    acked_s: float | None = None
    unloading_s: float | None = None
    released_s: float | None = None
    verified_s: float | None = None
    withdrawn_s: float | None = None  # nothing wanted the room any more
    verdict: str = ""

    def phases(self, until_s: float) -> tuple[Span, ...]:
        """Return the phases that were passed; the one under way ends at `until_s`."""
        ends = (self.acked_s, self.unloading_s, self.released_s, self.verified_s)
        spans, begin = [], self.asked_s
        for at, (name, end) in enumerate(zip(PHASES, ends, strict=True)):
            if end is None and any(later is not None for later in ends[at + 1 :]):
                continue  # not seen: its time counts for the next phase
            if end is None:
                going = self.withdrawn_s is None
                spans.append(Span(begin, self.withdrawn_s or until_s, name, going=going))
                break
            spans.append(Span(begin, end, name))
            begin = end
        return tuple(spans)


@dataclass(slots=True)
class LeaseStory:
    """One lease. `charges`: (since, bytes)."""

    lease_id: str
    consumer: str
    gpu: str | None = None
    states: list[Span] = field(default_factory=list)
    uses: list[Span] = field(default_factory=list)
    charges: list[tuple[float, int]] = field(default_factory=list)


@dataclass(slots=True)
class GpuStory:
    """One GPU. Capacity 0: unknown. `measured`: (since, bytes in use) of readings."""

    gpu: str
    title: str
    capacity_bytes: int = 0
    reserve_bytes: int = 0
    measured: list[tuple[float, int]] = field(default_factory=list)
    pressure: list[Span] = field(default_factory=list)
    held: dict[str, list[tuple[float, int]]] = field(default_factory=dict)
    """Bytes by name that take the place of the charges, where the GPU's own log has them."""


@dataclass(frozen=True, slots=True)
class Story:
    """All of it, within `begin_s` and `end_s`. `notices`: what is missing, in words."""

    begin_s: float
    end_s: float
    gpus: tuple[GpuStory, ...]
    leases: tuple[LeaseStory, ...]
    evictions: tuple[EvictionStory, ...]
    marks: tuple[Mark, ...]
    notices: tuple[str, ...] = ()

    @property
    def consumers(self) -> list[str]:
        """Consumers, and other names with bytes, in the order of their first appearance."""
        names = [lease.consumer for lease in self.leases]
        return list(dict.fromkeys([*names, *(name for gpu in self.gpus for name in gpu.held)]))

    @property
    def first_s(self) -> float:
        """Return when the first thing that is drawn begins."""
        spans = [one for lease in self.leases for one in (*lease.states[:1], *lease.uses[:1])]
        spans += [span for gpu in self.gpus for span in gpu.pressure[:1]]
        begins = [span.begin_s for span in spans] + [mark.at_s for mark in self.marks]
        begins += [points[0][0] for gpu in self.gpus for points in gpu.held.values() if points]
        return min(begins, default=self.begin_s)

    def evictions_by_lease(self) -> dict[str, list[EvictionStory]]:
        """Return the evictions of each lease, in their order."""
        found: dict[str, list[EvictionStory]] = {}
        for one in self.evictions:
            found.setdefault(one.lease_id, []).append(one)
        return found

    def bytes_by_name(self, gpu: GpuStory) -> dict[str, list[tuple[float, int]]]:
        """Return the steps of each name's bytes on a GPU: of its log, else charges by consumer."""
        if gpu.held:
            return gpu.held
        changes: dict[str, list[tuple[float, int]]] = {}
        for lease in self.leases:
            if lease.gpu != gpu.gpu:
                continue
            before = 0
            for at_s, count in lease.charges:
                changes.setdefault(lease.consumer, []).append((at_s, count - before))
                before = count
        found: dict[str, list[tuple[float, int]]] = {}
        for name, deltas in changes.items():
            total, steps = 0, list[tuple[float, int]]()
            for at_s, delta in sorted(deltas):
                total += delta
                steps.append((at_s, total))
            if any(count for _, count in steps):
                found[name] = steps
        return found


def within(story: Story, begin_s: float, end_s: float) -> Story:
    """Return the part of a story between two times: intervals are cut, steps keep their value."""

    def cut(spans: Iterable[Span]) -> list[Span]:
        return [
            replace(span, begin_s=max(begin_s, span.begin_s), end_s=min(end_s, span.end_s))
            for span in spans
            if span.begin_s <= end_s and span.end_s >= begin_s
        ]

    def steps(points: Sequence[tuple[float, int]]) -> list[tuple[float, int]]:
        before = [count for at_s, count in points if at_s <= begin_s]
        kept = [(at_s, count) for at_s, count in points if begin_s < at_s <= end_s]
        return [(begin_s, before[-1]), *kept] if before else kept

    leases = [
        replace(lease, states=cut(lease.states), uses=cut(lease.uses), charges=steps(lease.charges))
        for lease in story.leases
    ]
    gpus = [
        replace(
            gpu,
            measured=steps(gpu.measured),
            pressure=cut(gpu.pressure),
            held={name: steps(points) for name, points in gpu.held.items()},
        )
        for gpu in story.gpus
    ]
    return Story(
        begin_s,
        end_s,
        tuple(gpus),
        tuple(one for one in leases if one.states or one.uses or any(c for _, c in one.charges)),
        tuple(
            one
            for one in story.evictions
            if one.asked_s <= end_s and one.phases(end_s)[-1].end_s >= begin_s
        ),
        tuple(mark for mark in story.marks if begin_s <= mark.at_s <= end_s),
        story.notices,
    )
