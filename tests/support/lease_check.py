"""Independent checker of leases: three witnesses that never spoke to each other must tell one
story.

The GPU's allocation log says who held which bytes when; the history says what the arbiter decided;
the consumers' own traces say what they were told and did. From these follow the rules below; the
core's code is not used, its mistakes are what is looked for. `fakegpu_check` comes first and proves
that the GPU's log is sound in itself.

Rules (their names stand in `Finding.rule`):
  entitled   bytes are only put on the GPU under a lease: after its grant, before its end
  refused    whoever has a grant finds room for what it was granted
  exclusive  nobody else has bytes beyond its context while an exclusive lease has, nor the other
  way round
  in_use     nothing is unloaded while it is in use
  loading    one load at a time per GPU
  tokens     tokens only grow, across restarts too
  expired    only a holder that was hindered loses its lease by time
  stuck      every wait ends in bounded time
  crashed    no process of the test fell over by itself
"""

import bisect
import json
import re
from collections import Counter, defaultdict, deque
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any

from vram_arbiter.schemas.defaults import RESERVE_BYTES, VERIFY_TOLERANCE_BYTES

SLACK_S = 0.005
"""Between the clocks of history (wall) and of GPU and traces (monotonic)."""
UNSEEN_S = 2.5
"""A stowaway younger than the oldest reading that may carry a grant cannot have been seen."""
NOISE_BYTES = RESERVE_BYTES + VERIFY_TOLERANCE_BYTES
"""So much may be the driver's own, as far as a reading can tell: who has no more than that on its
way back is not seen to be there.

Where readings do not list processes, what a living process is charged for its context, and does not
hold, hides as many bytes more.
"""
STUCK_S = 60.0
_LEASE_ID = re.compile(r"L(\d+)-\d+")

type Line = Mapping[str, Any]
type Span = tuple[float, float]
"""From when until when, monotonic seconds."""


@dataclass(frozen=True, slots=True)
class Finding:
    """One thing that must not have happened."""

    rule: str
    t: float
    text: str


@dataclass(frozen=True, slots=True)
class Hindrance:
    """What the test itself did to a process: stopped from `since` to `until`, or killed (`until` is
    infinite)."""

    pid: int
    since: float
    until: float


@dataclass(slots=True)
class Claim:
    """A lease as its holder knew it. `until`: when it was over for the holder or, earlier, for the
    arbiter."""

    lease_id: str
    pid: int
    name: str
    exclusive: bool
    bytes: int
    token: tuple[int, int]
    since: float
    until: float = float("inf")
    expired_at: float = float("inf")  # by the arbiter's word


@dataclass(slots=True)
class Story:
    """What was found, and how much there was to look at."""

    findings: list[Finding] = field(default_factory=list)
    grants: int = 0
    switches: int = 0
    evictions: int = 0
    uses: int = 0
    allocations: int = 0
    refusals_excused: int = 0
    late_allocations: int = 0
    # seconds, of everybody who was served or refused
    waits: list[float] = field(default_factory=list)

    def bad(self, rule: str, t: float, text: str) -> None:
        self.findings.append(Finding(rule, t, text))


def read_lines(texts: Iterable[str]) -> list[dict[str, Any]]:
    """All traces in the order of time; a line that a kill tore is left out."""
    found = []
    for text in texts:
        for piece in text.split("\n"):
            try:
                found.append(json.loads(piece))
            except ValueError:
                continue
    return sorted(found, key=lambda line: float(line["t"]))


def check_leases(
    log: str,
    history: Sequence[Line],
    traces: Sequence[Line],
    hindrances: Sequence[Hindrance] = (),
    *,
    outages: Sequence[Span] = (),
    wall_minus_monotonic_s: float = 0.0,
    stuck_s: float = STUCK_S,
) -> Story:
    """Judge one GPU's log with the history of its arbiter and the traces of its consumers.

    `outages`: when the test itself had killed or stopped the arbiter, until it ran again.
    """
    story = Story()
    events = sorted(history, key=lambda event: (float(event["at_wall_s"]), int(event["seq"])))
    times = [float(event["at_wall_s"]) - wall_minus_monotonic_s for event in events]
    claims = _claims(traces, events, times)
    known = {claim.lease_id: claim for mine in claims.values() for claim in mine}
    _check_history(story, events, times, known, hindrances)
    _check_tokens(story, events, times, traces)
    _check_gpu(story, read_lines([log]), claims, traces, hindrances, _kept(events, times, traces))
    _check_uses(story, read_lines([log]), traces)
    _check_waits(story, traces, hindrances, outages, stuck_s)
    return story


# -- claims
def _claims(
    traces: Sequence[Line], events: Sequence[Line], times: Sequence[float]
) -> dict[int, list[Claim]]:
    """Per pid, in the order of their grants."""
    expired = {
        event["lease_id"]: t
        for event, t in zip(events, times, strict=True)
        if event["kind"] == "expired"
    }
    found: dict[int, list[Claim]] = defaultdict(list)
    by_lease: dict[str, Claim] = {}
    for line in traces:
        lease_id = line.get("lease_id")
        if line["event"] == "granted":
            claim = Claim(
                lease_id=str(lease_id),
                pid=line["pid"],
                name=line["name"],
                exclusive=line["exclusive"],
                bytes=line["bytes"],
                token=(line["token"][0], line["token"][1]),
                since=line["t"],
                expired_at=expired.get(lease_id, float("inf")),
            )
            found[claim.pid].append(claim)
            by_lease[claim.lease_id] = claim
        elif line["event"] in ("over", "lost") and lease_id in by_lease:
            by_lease[lease_id].until = min(by_lease[lease_id].until, line["t"])
    return found


def _kept(
    events: Sequence[Line], times: Sequence[float], traces: Sequence[Line]
) -> list[tuple[float, int, int]]:
    """(when, pid, bytes): what the arbiter charged to a process outside its leases from then on, by
    its verdicts, for its context.

    What it found there beyond what the process declared counts for nothing here: it would be
    excused by the arbiter's own finding.
    """
    declared = {
        line["name"]: (line["pid"], line["residue_bytes"])
        for line in traces
        if "residue_bytes" in line
    }
    found = []
    for event, t in zip(events, times, strict=True):
        if event["kind"] != "verified" or not event["resolved"]:
            continue
        if event.get("lease_id") is None:
            found.append((t, int(event["pid"]), 0))
        elif event["consumer"] in declared:
            pid, most = declared[event["consumer"]]
            found.append((t, pid, min(int(event["residue_bytes"]), most)))
    return found


def _claim_at(claims: Sequence[Claim], t: float) -> Claim | None:
    """The newest claim that was open at a time."""
    return next((claim for claim in reversed(claims) if claim.since <= t <= claim.until), None)


# -- history
def _check_history(
    story: Story,
    events: Sequence[Line],
    times: Sequence[float],
    claims: Mapping[str, Claim],
    hindrances: Sequence[Hindrance],
) -> None:
    loading: dict[str, dict[str, str]] = defaultdict(dict)  # GPU → lease → consumer
    uses: dict[str, set[str]] = defaultdict(set)  # as far as they began since the daemon did
    epoch = seq = 0
    for event, t in zip(events, times, strict=True):
        # a full disk, and a kill before there was room: what ended meanwhile is unknown
        if event["seq"] > seq + 1:
            loading.clear()
            uses.clear()
        seq = int(event["seq"])
        kind, lease, gpu = event["kind"], str(event.get("lease_id")), str(event.get("gpu"))
        begun = max(_epoch(lease), _epoch(str(event.get("wanted_by_lease"))))
        if begun > epoch:  # a start that a full disk kept out of the history
            epoch = begun
            loading.clear()
            uses.clear()
        match kind:
            case "started" | "recovered":  # what was under way is told again by those who come back
                loading.clear()
                uses.clear()
            case "reattached":
                uses.pop(lease, None)
            case "granted":
                story.grants += 1
                if loading[gpu]:
                    others = ", ".join(loading[gpu].values())
                    story.bad("loading", t, f"{event['consumer']} is granted while {others} loads")
                loading[gpu][lease] = str(event["consumer"])
            case "ready" | "released" | "lost" | "expired" | "denied":
                loading[gpu].pop(lease, None)
                # a lease released while the arbiter was down rightly ends by time
                claim = claims.get(lease)
                if kind == "expired" and claim is not None and t < claim.until:
                    if _hindered(hindrances, claim.pid, t):
                        continue
                    story.bad(
                        "expired",
                        t,
                        f"{lease} of {event['consumer']} expired, though nobody hindered it",
                    )
            case "unloading" if uses[lease]:
                story.bad(
                    "in_use",
                    t,
                    f"{lease} of {event['consumer']} unloads with {len(uses[lease])} uses",
                )
            case "switch":
                story.switches += bool(event.get("switched"))
            case "revoke_asked":
                story.evictions += 1
            case "use_began":
                story.uses += 1
                uses[lease].add(event["use_id"])
            case "use_ended":
                uses[lease].discard(event["use_id"])


def _check_tokens(
    story: Story, events: Sequence[Line], times: Sequence[float], traces: Sequence[Line]
) -> None:
    """The history has the order of the grants, their holders have the tokens. A lease of which one
    side missed a grant says nothing."""
    heard: dict[str, deque[tuple[int, int]]] = defaultdict(deque)
    for line in traces:
        if line["event"] == "granted":
            heard[str(line["lease_id"])].append((int(line["token"][0]), int(line["token"][1])))
    grants = [
        (event, t) for event, t in zip(events, times, strict=True) if event["kind"] == "granted"
    ]
    told = Counter(str(event["lease_id"]) for event, _ in grants)
    whole = {lease for lease, count in told.items() if count == len(heard[lease])}
    newest = (0, 0)
    for event, t in grants:
        lease = str(event["lease_id"])
        if lease not in whole:
            continue
        token = heard[lease].popleft()
        if token <= newest:
            story.bad("tokens", t, f"{lease} of {event['consumer']} has {token} after {newest}")
        newest = max(newest, token)


def _epoch(lease: str) -> int:
    """Which start of the daemon named a lease; 0 for no lease's id."""
    found = _LEASE_ID.fullmatch(lease)
    return int(found.group(1)) if found else 0


def _hindered(hindrances: Sequence[Hindrance], pid: int, t: float, back_s: float = 10.0) -> bool:
    return any(
        found.pid == pid and found.since <= t + SLACK_S and t - back_s <= found.until
        for found in hindrances
    )


# -- GPU
@dataclass(slots=True)
class _Held:
    """Bytes of one process as the log tells them. `floor` is what belongs to no lease: its context
    and what it leaked."""

    on_gpu: int = 0
    floor: int = 0
    leaked: int = 0
    grew_at: float = float("-inf")

    @property
    def own(self) -> int:
        return max(0, self.on_gpu - self.floor)


def _check_gpu(
    story: Story,
    lines: Sequence[Line],
    claims: Mapping[int, Sequence[Claim]],
    traces: Sequence[Line],
    hindrances: Sequence[Hindrance],
    kept: Sequence[tuple[float, int, int]],
) -> None:
    strangers = {
        line["pid"] for line in traces if line["event"] == "born" and line["kind"] == "stowaway"
    }
    consumers = {
        line["pid"] for line in traces if line["event"] == "born" and line["kind"] == "consumer"
    }
    held: dict[int, _Held] = defaultdict(_Held)
    late: set[int] = set()  # processes that put bytes there after their lease had expired
    dead = {h.pid: h.since for h in hindrances if h.until == float("inf")}
    dead |= {line["pid"]: line["t"] for line in traces if line["event"] == "done"}
    grants = deque(
        sorted((c for mine in claims.values() for c in mine), key=lambda claim: claim.since)
    )
    hidden: dict[str, int] = {}  # by lease: what a reading could not tell when it was granted
    for line in lines:
        pid, t, op = line["pid"], line["t"], line["op"]
        while grants and grants[0].since <= t:
            granted = grants.popleft()
            hidden[granted.lease_id] = _unfilled_bytes(kept, held, dead, granted.since)
        mine = held[pid]
        if op == "context":
            mine.floor += line["bytes"]
        elif op == "leak":
            mine.floor += line["bytes"]
            mine.leaked += line["bytes"]
        if pid:
            mine.on_gpu = line["process_bytes"]
        if op in ("context", "alloc") and line["delta"] > 0:
            mine.grew_at = t
        if pid not in consumers or op not in ("context", "alloc", "oom"):
            continue
        claim = _claim_at(claims.get(pid, ()), t)
        if claim is None:
            story.bad(
                "entitled", t, f"{line['name']} ({pid}) puts {line['bytes']} bytes without a lease"
            )
        elif claim.expired_at < t - SLACK_S:
            story.late_allocations += 1
            late.add(pid)
            if not _hindered(hindrances, pid, t):
                story.bad(
                    "entitled",
                    t,
                    f"{line['name']} ({pid}) loads under {claim.lease_id}, which expired",
                )
        elif op == "oom":
            _check_refusal(story, line, claim, held, strangers | late)
        else:
            story.allocations += 1
            _check_alone(story, line, claim, held, claims, NOISE_BYTES + hidden[claim.lease_id])


def _unfilled_bytes(
    kept: Sequence[tuple[float, int, int]],
    held: Mapping[int, _Held],
    dead: Mapping[int, float],
    at: float,
) -> int:
    """What living processes were charged outside their leases at that time and did not have on the
    GPU."""
    charged = {pid: count for t, pid, count in kept if t <= at and dead.get(pid, at) >= at}
    return sum(
        max(0, count - (held[pid].on_gpu if pid in held else 0)) for pid, count in charged.items()
    )


def _check_refusal(
    story: Story, line: Line, claim: Claim, held: Mapping[int, _Held], uninvited: set[int]
) -> None:
    for pid in uninvited:
        if held[pid].on_gpu and held[pid].grew_at >= claim.since - UNSEEN_S:
            story.refusals_excused += 1
            return
    mine = held[claim.pid]
    if (
        mine.leaked
        and mine.on_gpu + line["bytes"] - mine.leaked <= claim.bytes < mine.on_gpu + line["bytes"]
    ):
        story.refusals_excused += 1  # what it leaked before is in its own way
        return
    others = {pid: h.on_gpu for pid, h in held.items() if h.on_gpu and pid != claim.pid}
    story.bad(
        "refused",
        line["t"],
        f"{claim.name} was granted {claim.bytes} under {claim.lease_id}, holds {mine.on_gpu} and "
        "finds no room for "
        f"{line['bytes']}; others hold {others}",
    )


def _check_alone(
    story: Story,
    line: Line,
    claim: Claim,
    held: Mapping[int, _Held],
    claims: Mapping[int, Sequence[Claim]],
    unseen_bytes: int,
) -> None:
    t = line["t"]
    for pid, other in held.items():
        if pid == claim.pid or other.own <= unseen_bytes:
            continue
        theirs = next((c for c in reversed(claims.get(pid, ())) if c.since <= t), None)
        # a stowaway, or a holder that time took the lease from
        if theirs is None or theirs.expired_at < t:
            continue
        if claim.exclusive or theirs.exclusive:
            alone = claim if claim.exclusive else theirs
            story.bad(
                "exclusive",
                t,
                f"{alone.lease_id} of {alone.name} is exclusive: {claim.name} has "
                f"{held[claim.pid].own} bytes, "
                f"{theirs.name} {other.own}",
            )


# -- uses and waits
def _check_uses(story: Story, lines: Sequence[Line], traces: Sequence[Line]) -> None:
    """No bytes go, and no unload begins, between `in_use` and `idle` of a process."""
    gone: dict[int, list[float]] = defaultdict(list)
    for line in lines:
        if line["op"] == "free":
            gone[line["pid"]].append(line["t"])
    began: dict[int, Line] = {}
    for line in traces:
        pid = line["pid"]
        match line["event"]:
            case "in_use":
                began[pid] = line
            case "unload" if pid in began:
                story.bad("in_use", line["t"], f"{line['name']} unloads {line['lease_id']} in use")
            case "idle" if pid in began:
                since = began.pop(pid)["t"]
                index = bisect.bisect_left(gone[pid], since)
                if index < len(gone[pid]) and gone[pid][index] <= line["t"]:
                    story.bad(
                        "in_use", gone[pid][index], f"bytes of {line['name']} go while it is in use"
                    )


def _check_waits(
    story: Story,
    traces: Sequence[Line],
    hindrances: Sequence[Hindrance],
    outages: Sequence[Span],
    stuck_s: float,
) -> None:
    """Time in which the test kept the waiter or the arbiter from running is no wait."""
    asked: dict[int, Line] = {}
    ended = max((line["t"] for line in traces), default=0.0)
    killed = {h.pid: h.since for h in hindrances if h.until == float("inf")}

    def waited(line: Line, until: float) -> float:
        stops = [
            (h.since, h.until)
            for h in hindrances
            if h.pid == line["pid"] and h.until != float("inf")
        ]
        return float(until - line["t"] - _covered_s([*stops, *outages], line["t"], until))

    for line in traces:
        match line["event"]:
            case "asked":
                asked[line["pid"]] = line
            case "granted" | "denied" | "gave_up" if line["pid"] in asked:
                story.waits.append(waited(asked.pop(line["pid"]), line["t"]))
                if story.waits[-1] > stuck_s:
                    story.bad("stuck", line["t"], f"{line['name']} waited {story.waits[-1]:.1f} s")
            case "crashed":
                story.bad("crashed", line["t"], f"{line['name']}: {line['error']}")
    for pid, line in asked.items():
        if pid not in killed and waited(line, ended) > stuck_s:
            story.bad("stuck", ended, f"{line['name']} waits since {waited(line, ended):.1f} s")


def _covered_s(spans: Iterable[Span], since: float, until: float) -> float:
    """How much of the time between the two lies in any of the spans; what several of them cover
    counts once."""
    covered_s, seen_until = 0.0, since
    for begin, end in sorted(spans):
        begin, end = max(begin, seen_until), min(end, until)
        if end > begin:
            covered_s += end - begin
            seen_until = end
    return covered_s
