"""What happened on the GPUs: leases with their states and bytes, waits, uses, evictions, pressure,
and single moments. Times are wall seconds. `reader` makes it from events."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace

LEAVING = ("revoke", "quiesce", "unload", "verify")
"""States of a lease that leaves: until its holder answers, until its uses end, until it released,
until its bytes are measured gone."""
AWAY = ("queued", "standby", "parked")
"""States without bytes on a GPU; the others are `loading`, `held` and those of `LEAVING`."""


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
class Leaving:
    """A lease that was revoked. `end_s` None: it is still leaving."""

    lease_id: str
    consumer: str
    gpu: str | None
    wanted_by: str
    reason: str
    asked_s: float
    end_s: float | None = None
    verdict: str = ""


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
    evictions: tuple[Leaving, ...]
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

    def bytes_by_name(self, gpu: GpuStory) -> dict[str, list[tuple[float, int]]]:
        """Return the steps of each name's bytes on a GPU: of its log, else charges by consumer."""
        if gpu.held:
            return gpu.held
        changes: dict[str, list[tuple[float, int]]] = {}
        for lease in self.leases:
            before = 0
            for at_s, count in lease.charges if lease.gpu == gpu.gpu else ():
                changes.setdefault(lease.consumer, []).append((at_s, count - before))
                before = count
        found: dict[str, list[tuple[float, int]]] = {}
        for name, deltas in changes.items():
            total = 0
            for at_s, delta in sorted(deltas):
                total += delta
                found.setdefault(name, []).append((at_s, total))
        return {name: steps for name, steps in found.items() if any(count for _, count in steps)}


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
            if one.asked_s <= end_s and (one.end_s is None or one.end_s >= begin_s)
        ),
        tuple(mark for mark in story.marks if begin_s <= mark.at_s <= end_s),
        story.notices,
    )
