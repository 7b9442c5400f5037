"""The checker of leases finds each thing that must not happen, and is silent on a sound story."""

import json
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Any

import pytest

from tests.support.lease_check import NOISE_BYTES, Hindrance, Story, check_leases
from vram_arbiter.schemas.defaults import GIB

A, B, IDLE, STRANGER = 11, 12, 13, 99
FOREVER = float("inf")


@dataclass
class Scene:
    """Three witnesses, written by hand; time passes by one second a line."""

    t: float = 0.0
    log: list[dict[str, Any]] = field(default_factory=list)
    history: list[dict[str, Any]] = field(default_factory=list)
    traces: list[dict[str, Any]] = field(default_factory=list)
    hindrances: list[Hindrance] = field(default_factory=list)
    outages: list[tuple[float, float]] = field(default_factory=list)
    held: dict[int, int] = field(default_factory=dict)
    serial: int = 0

    def born(self, pid: int, kind: str = "consumer") -> None:
        self.trace(pid, "born", kind=kind)

    def trace(self, pid: int, event: str, **facts: Any) -> None:
        self.t += 1.0
        self.traces.append({"t": self.t, "pid": pid, "name": f"p{pid}", "event": event, **facts})

    def event(self, kind: str, **facts: Any) -> None:
        self.t += 1.0
        number = len(self.history) + 1
        self.history.append({"seq": number, "at_wall_s": self.t, "kind": kind, "gpu": "G", **facts})

    def op(self, pid: int, op: str, gib: float, delta: float | None = None) -> None:
        self.t += 1.0
        size, change = int(gib * GIB), int((gib if delta is None else delta) * GIB)
        self.held[pid] = self.held.get(pid, 0) + change
        line = {
            "t": self.t,
            "pid": pid,
            "name": f"p{pid}",
            "op": op,
            "bytes": size,
            "delta": change,
        }
        self.log.append({**line, "process_bytes": self.held[pid]})

    def grant(self, pid: int, gib: float, *, exclusive: bool = False) -> str:
        """Asked, granted, told, loaded, ready."""
        self.serial += 1
        lease = f"L1-{self.serial}"
        self.trace(pid, "asked", bytes=int(gib * GIB), exclusive=exclusive)
        self.event("granted", lease_id=lease, consumer=f"p{pid}")
        facts = {"bytes": int(gib * GIB), "exclusive": exclusive, "token": [1, self.serial]}
        self.trace(pid, "granted", lease_id=lease, **facts)
        self.op(pid, "alloc", gib)
        self.event("ready", lease_id=lease, consumer=f"p{pid}")
        return lease

    def over(self, pid: int, lease: str) -> None:
        self.op(pid, "free", self.held[pid] / GIB, 0)
        self.event("released", lease_id=lease, consumer=f"p{pid}")
        self.op(pid, "returned", self.held[pid] / GIB, -self.held[pid] / GIB)
        self.trace(pid, "over", lease_id=lease)

    def judge(self) -> Story:
        log = "".join(json.dumps(line) + "\n" for line in self.log)
        return check_leases(log, self.history, self.traces, self.hindrances, outages=self.outages)


def sound() -> Scene:
    """A holds 4 GiB, is used, leaves; B comes alone."""
    scene = Scene()
    scene.born(A)
    scene.born(B)
    lease = scene.grant(A, 4)
    scene.event("use_began", lease_id=lease, use_id="u")
    scene.trace(A, "in_use", lease_id=lease)
    scene.trace(A, "idle", lease_id=lease)
    scene.event("use_ended", lease_id=lease, use_id="u")
    scene.event("unloading", lease_id=lease, consumer="pA")
    scene.trace(A, "unload", lease_id=lease)
    scene.over(A, lease)
    scene.grant(B, 6, exclusive=True)
    return scene


def test_a_sound_story_is_not_complained_about() -> None:
    story = sound().judge()
    assert not story.findings
    assert (story.grants, story.uses, story.allocations, len(story.waits)) == (2, 1, 2, 2)


# -- each rule, broken
def without_a_lease(scene: Scene) -> None:
    scene.op(A, "alloc", 1)


def under_an_expired_lease(scene: Scene) -> None:
    lease = scene.grant(A, 1)
    scene.hindrances.append(Hindrance(A, -100.0, -90.0))
    scene.event("expired", lease_id=lease, consumer="pA")
    scene.op(A, "alloc", 1)


def no_room_for_a_grant(scene: Scene) -> None:
    scene.grant(A, 1)
    scene.op(A, "oom", 1, 0)


def beside_an_exclusive_lease(scene: Scene) -> None:
    scene.grant(A, 1)


def exclusive_beside_a_dying_one(scene: Scene) -> None:
    other = Scene()
    other.born(A)
    other.born(B)
    lease = other.grant(A, 2)
    other.op(A, "died", 2, 0)
    other.event("lost", lease_id=lease, consumer="pA")
    other.grant(B, 1, exclusive=True)
    scene.__dict__.update(other.__dict__)


def unloads_in_use_by_its_own_word(scene: Scene) -> None:
    scene.trace(B, "in_use", lease_id="L1-2")
    scene.trace(B, "unload", lease_id="L1-2")


def unloads_in_use_by_the_gpu(scene: Scene) -> None:
    scene.trace(B, "in_use", lease_id="L1-2")
    scene.op(B, "free", 6, 0)
    scene.trace(B, "idle", lease_id="L1-2")


def unloads_in_use_by_the_history(scene: Scene) -> None:
    scene.event("use_began", lease_id="L1-2", use_id="u")
    scene.event("unloading", lease_id="L1-2", consumer="pB")


def two_loads_at_once(scene: Scene) -> None:
    for serial in (8, 9):
        scene.event("granted", lease_id=f"L1-{serial}", consumer=f"c{serial}")


def a_token_again(scene: Scene) -> None:
    scene.event("granted", lease_id="L1-9", consumer="c")
    scene.trace(B, "granted", lease_id="L1-9", bytes=1, exclusive=False, token=[1, 2])


def expired_though_well(scene: Scene) -> None:
    scene.event("expired", lease_id="L1-2", consumer="pB")


def waits_for_ever(scene: Scene) -> None:
    scene.trace(A, "asked", bytes=1, exclusive=False)
    scene.t += 100.0
    scene.trace(B, "done")


def served_very_late(scene: Scene) -> None:
    scene.trace(A, "asked", bytes=1, exclusive=False)
    scene.t += 100.0
    scene.trace(A, "denied", code="wait_timeout")


def falls_over(scene: Scene) -> None:
    scene.trace(A, "crashed", error="ZeroDivisionError()")


@pytest.mark.parametrize(
    ("rule", "breaks"),
    [
        ("entitled", without_a_lease),
        ("entitled", under_an_expired_lease),
        ("refused", no_room_for_a_grant),
        ("exclusive", beside_an_exclusive_lease),
        ("exclusive", exclusive_beside_a_dying_one),
        ("in_use", unloads_in_use_by_its_own_word),
        ("in_use", unloads_in_use_by_the_gpu),
        ("in_use", unloads_in_use_by_the_history),
        ("loading", two_loads_at_once),
        ("tokens", a_token_again),
        ("expired", expired_though_well),
        ("stuck", waits_for_ever),
        ("stuck", served_very_late),
        ("crashed", falls_over),
    ],
)
def test_each_broken_rule_is_found(rule: str, breaks: Callable[[Scene], None]) -> None:
    scene = sound()
    breaks(scene)
    assert rule in {finding.rule for finding in scene.judge().findings}


# -- what is excused
def test_a_stowaway_that_nobody_can_have_seen_excuses_a_refusal() -> None:
    scene = Scene()
    scene.born(A)
    scene.born(STRANGER, "stowaway")
    scene.grant(A, 1)
    scene.op(STRANGER, "alloc", 6)
    scene.op(A, "oom", 2, 0)
    story = scene.judge()
    assert (story.findings, story.refusals_excused) == ([], 1)


def test_a_process_that_was_stopped_may_expire_load_late_and_wait_long() -> None:
    scene = Scene()
    scene.born(A)
    lease = scene.grant(A, 1)
    scene.hindrances.append(Hindrance(A, scene.t, scene.t + 3.0))
    scene.event("expired", lease_id=lease, consumer="pA")
    scene.op(A, "alloc", 1)
    scene.trace(A, "asked", bytes=1, exclusive=False)
    scene.hindrances.append(Hindrance(A, scene.t, scene.t + 100.0))
    scene.t += 100.0
    scene.trace(A, "denied", code="wait_timeout")
    story = scene.judge()
    assert (story.findings, story.late_allocations) == ([], 1)


def test_what_it_leaked_itself_is_in_its_own_way() -> None:
    scene = Scene()
    scene.born(A)
    lease = scene.grant(A, 4)
    scene.op(A, "leak", 1, 0)
    scene.op(A, "returned", 3, -3)
    scene.trace(A, "over", lease_id=lease)
    scene.grant(A, 3)
    scene.op(A, "oom", 0.5, 0)
    scene.traces[-1]["bytes"] = int(3.5 * GIB)
    story = scene.judge()
    assert (story.findings, story.refusals_excused) == ([], 1)


def test_a_killed_waiter_is_not_stuck() -> None:
    scene = sound()
    scene.trace(A, "asked", bytes=1, exclusive=False)
    scene.hindrances.append(Hindrance(A, scene.t, FOREVER))
    scene.t += 100.0
    scene.trace(B, "done")
    assert not scene.judge().findings


def beside_what_is_on_its_way(
    left_gib: float, *, charged_gib: float, declared_gib: float = 0.25, ended: str = ""
) -> list[str]:
    """B is granted a GPU to itself when this much of A's is still there, and IDLE is charged a
    context that it never put there."""
    scene = Scene()
    for pid in (A, B, IDLE):
        scene.born(pid)
    scene.trace(IDLE, "asked", bytes=GIB, exclusive=False, residue_bytes=int(declared_gib * GIB))
    # granted while its process was stopped: it never heard of it
    verdict = {"lease_id": "L1-1", "consumer": f"p{IDLE}"}
    scene.event("verified", **verdict, resolved=False, residue_bytes=9 * GIB)
    scene.event("verified", **verdict, resolved=True, residue_bytes=int(charged_gib * GIB))
    scene.trace(IDLE, "denied", code="lease_lost")
    scene.serial = 1
    lease = scene.grant(A, left_gib)
    scene.op(A, "free", left_gib, 0)
    scene.event("released", lease_id=lease, consumer="pA")
    scene.event("verified", lease_id=lease, consumer="pA", resolved=True, residue_bytes=0)
    scene.trace(A, "over", lease_id=lease)
    match ended:
        case "killed":
            scene.hindrances.append(Hindrance(IDLE, scene.t, FOREVER))
        case "exited":
            scene.trace(IDLE, "done")
        case "measured gone":
            scene.event("verified", lease_id=None, pid=IDLE, resolved=True, residue_bytes=0)
    scene.grant(B, 1, exclusive=True)
    return [finding.rule for finding in scene.judge().findings]


MOST_GIB = NOISE_BYTES / GIB


@pytest.mark.parametrize("charged_gib", [0.0, 0.25])
def test_what_no_reading_can_tell_may_be_beside_an_exclusive_lease_and_no_byte_more(
    charged_gib: float,
) -> None:
    """Without process lists, what a process is charged and does not hold cannot be told from what
    another still has."""
    assert beside_what_is_on_its_way(MOST_GIB + charged_gib, charged_gib=charged_gib) == []
    assert beside_what_is_on_its_way(MOST_GIB + charged_gib + 1 / GIB, charged_gib=charged_gib) == [
        "exclusive"
    ]


@pytest.mark.parametrize("ended", ["killed", "exited", "measured gone"])
def test_a_process_that_has_ended_hides_nothing(ended: str) -> None:
    assert beside_what_is_on_its_way(MOST_GIB + 1 / GIB, charged_gib=0.25, ended=ended) == [
        "exclusive"
    ]


def test_what_the_arbiter_found_beyond_a_context_hides_nothing() -> None:
    assert beside_what_is_on_its_way(MOST_GIB + 0.25 + 1 / GIB, charged_gib=2) == ["exclusive"]
    assert beside_what_is_on_its_way(MOST_GIB + 1 / GIB, charged_gib=2, declared_gib=0) == [
        "exclusive"
    ]


@pytest.mark.parametrize(
    ("outages", "stuck"), [([], True), ([(0.0, 30.0)], True), ([(0.0, 50.0)], False)]
)
def test_time_without_an_arbiter_is_no_wait(
    outages: list[tuple[float, float]], stuck: bool
) -> None:
    """Regression (storm, seed 7): killed and stopped again and again, the daemon had answered for
    29 s of 70."""
    scene = sound()
    scene.trace(A, "asked", bytes=1, exclusive=False)
    asked_at = scene.t
    scene.hindrances.append(Hindrance(A, asked_at + 20.0, asked_at + 40.0))
    scene.outages = [(asked_at + since, asked_at + until) for since, until in outages]
    scene.t += 108.0
    scene.trace(A, "denied", code="wait_timeout")
    story = scene.judge()
    assert [finding.rule for finding in story.findings] == ["stuck"] * stuck
    if outages:
        assert story.waits[-1] == pytest.approx(109.0 - max(40.0, outages[0][1])), (
            "what both cover counts once"
        )


def test_what_ended_in_a_part_of_the_history_that_was_lost_is_not_missed() -> None:
    """Regression (storm, seed 7): the end of a use was never written, the disk being full until the
    daemon was killed."""

    def story(lost: int) -> list[str]:
        scene = Scene()
        scene.born(A)
        lease = scene.grant(A, 4)
        scene.event("use_began", lease_id=lease, consumer="pA", use_id="u1")
        scene.event("granted", lease_id="L1-8", consumer="c8")
        scene.event("use_ended", lease_id=lease, consumer="pA", use_id="u1")
        scene.event("ready", lease_id="L1-8", consumer="c8")
        del scene.history[len(scene.history) - lost :]
        for event in (
            {"kind": "granted", "lease_id": "L1-9", "consumer": "c9"},
            {"kind": "unloading", "lease_id": lease, "consumer": "pA"},
        ):
            scene.event(**event)
            scene.history[-1]["seq"] += lost
        return sorted(finding.rule for finding in scene.judge().findings)

    assert story(0) == []
    assert story(2) == []
    whole = Scene()
    whole.born(A)
    lease = whole.grant(A, 4)
    whole.event("use_began", lease_id=lease, consumer="pA", use_id="u1")
    whole.event("unloading", lease_id=lease, consumer="pA")
    assert [finding.rule for finding in whole.judge().findings] == ["in_use"]


def test_a_start_that_a_full_disk_kept_out_of_the_history_is_seen_by_the_names_of_leases() -> None:
    """Regression: a use whose end the killed daemon did not write down counted on in the next one's
    life."""

    def story(wanted_by: str) -> list[str]:
        scene = Scene()
        scene.born(A)
        lease = scene.grant(A, 4)
        scene.event("use_began", lease_id=lease, consumer="pA", use_id="u1")
        scene.event("revoke_asked", lease_id=lease, consumer="pA", wanted_by_lease=wanted_by)
        scene.event("unloading", lease_id=lease, consumer="pA")
        scene.over(A, lease)
        return [finding.rule for finding in scene.judge().findings]

    assert story("L1-9") == ["in_use"]
    assert story("L2-1") == []
