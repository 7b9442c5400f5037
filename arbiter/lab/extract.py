"""A log as a workload: what its consumers wanted, their durations, and the outcome.

The log is run through the engine once more, and the engine's own notes tell the story of every
lease. Future events depend on decisions (a holder releases because it was revoked), so only what
decisions do not change is taken over: arrivals, durations of loads, uses and unloads, footprints,
voluntary releases and their times.
"""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field, replace
from statistics import median

from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.effects import Effect, Note, Refuse, Reply
from vram_arbiter.arbiter.core.events import (
    AcquireRequested,
    MemorySampled,
    ProbeFailed,
    ProcessDied,
    Reacquired,
)
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.arbiter.core.settings import Settings
from vram_arbiter.arbiter.eventlog.logfile import Entry, LogFile
from vram_arbiter.arbiter.eventlog.replay import Replayed, replay
from vram_arbiter.arbiter.lab.outcome import Outcome
from vram_arbiter.arbiter.lab.workload import GpuPlan, Job, Plan, Workload
from vram_arbiter.schemas.ids import GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire import notes
from vram_arbiter.schemas.wire.replies import AcquireReply
from vram_arbiter.schemas.wire.spec import LeaseSpec

POLLING_S = 0.05
"""Duration of a verification on a GPU without lag: two readings that agree."""
LEAST_PATIENCE_S = 0.001
PENT_UP_S = 0.05
"""A use that begins so soon after the one before it had waited for it; its arrival is not in the
log."""


@dataclass(slots=True)
class _Use:
    began_at: float
    ended_at: float | None = None


@dataclass(slots=True)
class _Story:
    """One lease, from its acquire to its end. Times are the log's."""

    process: ProcessKey
    spec: LeaseSpec
    acquired_at: float
    wait_timeout_s: float | None = None
    inherited: bool = False  # it was resident when the log began
    granted_at: float | None = None
    ready_at: float | None = None
    measured_bytes: int | None = None
    uses: list[_Use] = field(default_factory=list)
    running: dict[str, _Use] = field(default_factory=dict)
    asked_at: float | None = None
    unloading_at: float | None = None
    released_at: float | None = None
    ended_at: float | None = None  # anyhow
    gave_up: bool = False
    by_itself: bool = False  # it came back from standby by itself

    @property
    def last_busy_at(self) -> float:
        """Return when it was last needed."""
        ends = [use.ended_at for use in self.uses if use.ended_at is not None]
        return max([*ends, self.ready_at or self.acquired_at])

    def lasted(self, until: float) -> float:
        """Return when its process was free for the next one: its bytes may still be under
        verification."""
        ends = [at for at in (self.released_at, self.ended_at) if at is not None]
        return min(ends, default=until)


@dataclass(slots=True)
class Extract:
    """A log's workload beside its real outcome."""

    workload: Workload
    logged: Outcome
    settings: Settings
    replayed: Replayed


def extract(files: Sequence[LogFile]) -> Extract:
    """Read a log. Raises LogError.

    A log of another engine is read as this engine decides on its events.
    """
    reader = _Reader(files[0].header.settings)
    found = replay(files, reader.see, to_the_end=True)
    return reader.extract(found)


class _Reader:
    def __init__(self, settings: Settings) -> None:
        self.outcome = Outcome(settings.policy, 0.0)
        self._settings = settings
        self._stories: dict[LeaseId, _Story] = {}
        self._began: float | None = None
        self._away: dict[LeaseId, _Story] = {}  # on standby or parked: the same lease may come back
        self._died: dict[ProcessKey, float] = {}
        self._verified_s: list[float] = []
        self._totals: dict[GpuId, int] = {}
        self._least_used: dict[GpuId, int] = {}
        self._peak = 0
        self._others: dict[GpuId, list[tuple[float, str, int]]] = {}
        self._now_others: dict[GpuId, dict[str, int]] = {}
        self._odd: dict[str, int] = {}

    # -- reading
    def see(self, arbiter: Arbiter, entry: Entry, effects: Sequence[Effect]) -> None:
        if self._began is None:
            self._began = entry.now
        core = arbiter.inspect()
        self.outcome.watch(entry.now - self._began, effects)
        event = entry.event
        match event:
            case AcquireRequested():
                self._acquired(arbiter, event, entry.now, effects)
            case ProcessDied(process):
                self._died[process] = entry.now
            case Reacquired() if event.lease in self._away:
                self._back(event.lease, entry.now)
            case MemorySampled():
                self._sampled(arbiter, event, entry.now)
            case ProbeFailed():
                self._count("readings that failed are not repeated")
            case _:
                pass
        for lease in core.leases.values():
            if lease.id not in self._stories and lease.id not in self._away:
                self._inherit(lease, entry.now)
        for effect in effects:
            if isinstance(effect, Note):
                self._hear(effect, entry.now)

    def _inherit(self, lease: Lease, now: float) -> None:
        """Note a lease that was recovered, or resident when the log began."""
        known = self._stories[lease.id] = _Story(lease.process, lease.spec, now, inherited=True)
        if lease.ready_at:
            known.granted_at = known.ready_at = now
            known.measured_bytes = lease.observed.reported_bytes

    def _hear(self, note: Note, now: float) -> None:
        lease = None if note.about is None else note.about.lease_id
        if lease is None:
            return
        if isinstance(note.body, notes.GrantedNote) and lease in self._away:
            self._back(lease, now)
            self._stories[lease].by_itself = True
        if (story := self._stories.get(lease)) is None:
            return
        self._noted(story, note.body, now)
        if isinstance(note.body, notes.StandbyNote | notes.ParkedNote):
            story.ended_at = story.ended_at or now
            self._away[lease] = self._stories.pop(lease)
            self._stories[LeaseId(f"{lease} until {now}")] = story

    def _back(self, lease: LeaseId, now: float) -> None:
        before = self._away.pop(lease)
        self._stories[lease] = _Story(before.process, before.spec, now)

    def _acquired(
        self, arbiter: Arbiter, event: AcquireRequested, now: float, effects: Sequence[Effect]
    ) -> None:
        client = arbiter.inspect().clients.get(event.client)
        for effect in effects:
            match effect:
                case Reply(_, request, AcquireReply(lease=view)) if (
                    request == event.request and client is not None
                ):
                    lease = LeaseId(view.lease_id)
                    self._away.pop(lease, None)
                    if lease not in self._stories:
                        self._stories[lease] = _Story(
                            client.process, event.spec, now, event.wait_timeout_s
                        )
                case Refuse(_, request) if request == event.request and client is not None:
                    story = _Story(client.process, event.spec, now, ended_at=now)
                    self._stories[LeaseId(f"refused {len(self._stories)}")] = story
                    self.outcome.of(event.spec.consumer).denied += 1
                case _:
                    pass

    def _noted(self, story: _Story, body: notes.AnyNote, now: float) -> None:
        match body:
            case notes.GrantedNote():
                story.granted_at = now
            case notes.ReadyNote(measured_bytes=measured_bytes):
                story.ready_at, story.measured_bytes = now, measured_bytes
            case notes.UseBeganNote(use_id):
                story.running[use_id] = use = _Use(now)
                story.uses.append(use)
            case notes.UseEndedNote(use_id):
                if (ending := story.running.pop(use_id, None)) is not None:
                    ending.ended_at = now
            case notes.RevokeAskedNote():
                story.asked_at = now
            case notes.UnloadingNote():
                story.unloading_at = now
            case notes.ReleasedNote():
                story.released_at = now
                story.unloading_at = story.unloading_at or now
            case notes.VerifiedNote(resolved=True, ms=ms):
                self._verified_s.append(ms / 1e3)
                story.ended_at = story.ended_at or now
            case (
                notes.DeniedNote() | notes.CancelledNote() | notes.ExpiredNote() | notes.LostNote()
            ):
                story.ended_at = now
                story.gave_up = isinstance(body, notes.CancelledNote)
            case _:
                pass

    def _sampled(self, arbiter: Arbiter, event: MemorySampled, now: float) -> None:
        self._totals[event.gpu] = event.total_bytes
        self._least_used[event.gpu] = min(
            self._least_used.get(event.gpu, event.used_bytes), event.used_bytes
        )
        self._peak = max(self._peak, event.used_bytes)
        gpu = arbiter.inspect().gpus.get(event.gpu)
        if gpu is None:
            return
        seen = {
            f"{s.name or 'pid'} {s.process.pid}": s.held_bytes
            for s in gpu.ledger.stowaways.values()
        }
        before = self._now_others.get(event.gpu, {})
        changes = self._others.setdefault(event.gpu, [])
        began = self._began or now
        changes += [
            (now - began, name, count) for name, count in seen.items() if before.get(name) != count
        ]
        changes += [(now - began, name, 0) for name in before if name not in seen]
        self._now_others[event.gpu] = seen

    def _count(self, what: str) -> None:
        self._odd[what] = self._odd.get(what, 0) + 1

    # -- concluding
    def extract(self, found: Replayed) -> Extract:
        began = found.began_at if self._began is None else self._began
        until = found.ended_at
        lanes = self._lanes(until)
        plans = [self._plan(lane, began, until) for lane in lanes]
        lag_s = max(0.0, median(self._verified_s) - POLLING_S) if self._verified_s else 0.0
        gpus = [
            GpuPlan(
                info,
                self._totals.get(info.id, info.capacity_bytes),
                self._overhead(info.id),
                lag_s,
                tuple(self._others.get(info.id, ())),
            )
            for info in self._settings.gpus
        ]
        self.outcome.seconds = until - began
        self.outcome.peak_bytes = self._peak
        if any(story.spec.park_bytes for story in self._stories.values()):
            self._count("parking is not simulated: a load takes as long as it took in the log")
        notes = [f"{what} ({count})" for what, count in sorted(self._odd.items())]
        if found.gaps:
            notes.append("the recording was interrupted; what was resident then is taken as loaded")
        workload = Workload(gpus, plans, until - began, notes)
        return Extract(workload, self.outcome, self._settings, found)

    def _overhead(self, gpu: GpuId) -> int:
        """Return the GPU's bytes at its emptiest, the driver's own share.

        While leases were held all the time nothing can be said, and nothing is assumed.
        """
        resident = any(story.inherited for story in self._stories.values())
        others = sum(count for _, _, count in self._others.get(gpu, ()))
        return 0 if resident or others else self._least_used.get(gpu, 0)

    def _lanes(self, until: float) -> list[list[_Story]]:
        """Return groups of leases that one actor may live through in order.

        They are of one process and consumer, and not at the same time.
        """
        lanes: dict[tuple[ProcessKey, str], list[list[_Story]]] = {}
        for story in sorted(self._stories.values(), key=lambda story: story.acquired_at):
            mine = lanes.setdefault((story.process, story.spec.consumer), [])
            free = next(
                (lane for lane in mine if lane[-1].lasted(until) <= story.acquired_at), None
            )
            if free is None:
                mine.append([story])
            else:
                free.append(story)
        return [lane for group in lanes.values() for lane in group]

    def _plan(self, lane: Sequence[_Story], began: float, until: float) -> Plan:
        tally = self.outcome.of(lane[0].spec.consumer)
        loads = [load for s in lane if (load := _load_s(s)) is not None]
        unloads = [s.released_at - s.unloading_at for s in lane if s.released_at and s.unloading_at]
        typical = (_middle(loads), _middle(unloads))
        jobs: list[Job] = []
        for story in lane:
            mine = _jobs(story, began, until, typical)
            jobs += mine
            tally.jobs += len(mine)
            until_ready = (story.ready_at or story.lasted(until)) - story.acquired_at
            wanted = not story.by_itself
            tally.waits_s += [
                until_ready if wanted and job.due_s == mine[0].due_s else 0.0 for job in mine
            ]
            tally.unserved += story.ready_at is None and story.ended_at is None
        heeds = [
            s.unloading_at - max(s.asked_at, s.last_busy_at)
            for s in lane
            if s.asked_at and s.unloading_at
        ]
        died = self._died.get(lane[0].process)
        return Plan(
            lane[0].spec.consumer,
            jobs,
            heed_s=max(0.0, _middle(heeds)),
            leaves_s=None if died is None else died - began,
            resident=lane[0].inherited and lane[0].ready_at is not None,
        )


def _load_s(story: _Story) -> float | None:
    if story.ready_at is None or story.granted_at is None or story.inherited:
        return None
    return story.ready_at - story.granted_at


def _middle(values: Iterable[float]) -> float:
    found = list(values)
    return median(found) if found else 0.0


def _jobs(story: _Story, began: float, until: float, typical: tuple[float, float]) -> list[Job]:
    """Return the lease's uses, or one job that only holds."""
    load_s = _load_s(story)
    unload_s = (
        story.released_at - story.unloading_at
        if story.released_at and story.unloading_at
        else typical[1]
    )
    patience = story.wait_timeout_s
    if story.gave_up and story.ended_at is not None:
        patience = max(LEAST_PATIENCE_S, story.ended_at - story.acquired_at)
    base = Job(
        story.acquired_at - began,
        story.spec,
        None,
        typical[0] if load_s is None else load_s,
        unload_s,
        measured_bytes=story.measured_bytes,
        wait_timeout_s=patience,
    )
    uses = story.uses
    voluntary = story.released_at is not None and story.asked_at is None
    after = max(0.0, (story.released_at or 0.0) - story.last_busy_at) if voluntary else None
    ready = story.ready_at
    if not uses and story.by_itself:
        return []
    if not uses or ready is None:
        return [replace(base, release_after_s=after)]
    jobs: list[Job] = []
    over = ready  # when everything before was over
    for number, use in enumerate(uses):
        due_s = use.began_at - began
        if number == 0 and not story.by_itself:
            due_s = base.due_s
        elif number and 0.0 <= use.began_at - over <= PENT_UP_S:
            due_s = jobs[-1].due_s
        job = replace(
            base,
            due_s=due_s,
            use_s=(use.ended_at or until) - use.began_at,
            settle_s=use.began_at - ready if number == 0 and not story.by_itself else 0.0,
            alongside=number > 0 and use.began_at < over,
        )
        jobs.append(job)
        over = max(over, use.ended_at or until)
    jobs[-1] = replace(jobs[-1], release_after_s=after)
    return jobs
