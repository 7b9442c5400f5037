"""Whole judgements of single readings, each at its edge: one byte more or one moment earlier is
judged otherwise."""

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import pytest

from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.ledger import GpuLedger
from vram_arbiter.arbiter.core.model.gpu import Gpu, WaitQueue
from vram_arbiter.arbiter.core.model.lease import (
    Lease,
    LeaseState,
    Request,
    Verdict,
    Verification,
)
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.arbiter.core.verification.judge import (
    DYING_S,
    Judgement,
    Others,
    judge,
    others_since,
)
from vram_arbiter.schemas.ids import ClientId, GpuId, LeaseId, ProcessKey
from vram_arbiter.schemas.wire.notes import Culprit
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

ME = 1
"""Pid of the process that released; its lease of 1000 bytes declares 50 of residue."""
OTHER = 2
"""Pid of a holder of 400 bytes that has taken 300 of them."""
DRIVER_BYTES, TOLERANCE_BYTES = 20, 10
GPU = GpuId("GPU-0")


def process(pid: int) -> ProcessKey:
    return ProcessKey(pid, 7 * pid)


def reading(at: float, used: int, listed: Mapping[int, int | None] | None) -> MemorySampled:
    """A reading by pid; None: a total alone."""
    uses = None
    if listed is not None:
        uses = tuple(ProcessUse(process(pid), f"p{pid}", count) for pid, count in listed.items())
    return MemorySampled(GPU, at, used, 10_000, uses)


class World:
    """One GPU whose driver holds 20 bytes, and leases by hand."""

    def __init__(self) -> None:
        info = GpuInfo(GPU, 0, "gpu", capacity_bytes=10_000, reserve_bytes=100)
        self.gpu = Gpu(info, GpuLedger(info, TOLERANCE_BYTES), WaitQueue(5.0), [])
        self.gpu.ledger.observe(reading(0.5, DRIVER_BYTES, {}), quiet=True)

    def lease(
        self,
        pid: int,
        charge: int,
        *,
        state: LeaseState = LeaseState.HELD,
        ready_at: float = 1.0,
        name: str = "",
    ) -> Lease:
        spec = LeaseSpec(consumer=f"p{pid}", model_id="m", footprint=Footprint(charge, charge, 0))
        lease = Lease(
            LeaseId(name or f"L{pid}"),
            spec,
            process(pid),
            ClientId("c"),
            Request("n", 0.0, pid, charge, charge),
            state=state,
            ready_at=ready_at,
        )
        self.gpu.ledger.charge(lease.id, lease.process, charge, charge, 1.0)
        self.gpu.residents.add(lease)
        return lease

    def debt(self, pid: int, lease: str | None, confirmed_at: float) -> None:
        """A verification of another process."""
        one = replace(
            RELEASED,
            key=f"debt{pid}",
            process=process(pid),
            lease=None if lease is None else LeaseId(lease),
        )
        one.confirmed_at = confirmed_at
        self.gpu.verifications[one.key] = one


BEFORE = reading(10.0, 1320, {ME: 1000, OTHER: 300})
RELEASED = Verification(
    key="L1",
    process=process(ME),
    lease=LeaseId("L1"),
    consumer="det",
    model="det m",
    retained_bytes=50,
    baseline=BEFORE,
    baseline_comparable=True,
    confirmed_at=11.0,
    not_before=11.0,
    deadline_at=21.0,
)
DEAD: dict[str, Any] = {"alive": False, "vanishes": True, "retained_bytes": 0}
LATE: dict[str, Any] = {"overdue": True}
SEEN = {ME: 60, OTHER: 300}
BACK = Judgement(Verdict.VERIFIED, False, 50)


def residue(count: int, *culprits: Culprit, resolved: bool = True) -> Judgement:
    return Judgement(Verdict.RESIDUE, resolved, count, culprits)


def contested(count: int, *culprits: Culprit, resolved: bool = True) -> Judgement:
    return Judgement(Verdict.CONTESTED, resolved, count, culprits)


type Case = tuple[dict[str, Any], MemorySampled, Others, Judgement | None]
TOTALS = {"baseline": reading(10.0, 1320, None)}
HIDDEN = {"baseline": reading(10.0, 920, {OTHER: 300})}  # 600 of it may be the process's own
UNKNOWN = {"baseline": reading(10.0, 1320, None), "baseline_comparable": False}
NO_BASELINE = {"baseline": None}
GROWN = Others(grown_bytes=500)
LOADS = Others(grown_bytes=500, loading_bytes=30)
X9, X8 = Culprit(9, "p9", 100), Culprit(8, "p8", 100)
IN_TIME: dict[str, Case] = {
    "all but the tolerance is back": ({}, reading(20, 380, SEEN), Others(), BACK),
    "one byte is missing": ({}, reading(20, 381, SEEN), Others(), None),
    "one byte is still its own": ({}, reading(20, 380, {**SEEN, ME: 61}), Others(), None),
    "others may have grown": ({}, reading(20, 480, SEEN), GROWN, BACK),
    "beyond what all are charged": ({}, reading(20, 481, SEEN), GROWN, None),
    "a load has not come": ({}, reading(20, 450, SEEN), LOADS, BACK),
    "a load may hide a byte": ({}, reading(20, 451, SEEN), LOADS, None),
    "a load hides less than the delta": (
        {}, reading(20, 351, SEEN), Others(loading_bytes=30), None,
    ),
    "the ledger alone": (NO_BASELINE, reading(20, 480, SEEN), Others(), BACK),
    "the ledger alone, exceeded": (NO_BASELINE, reading(20, 481, SEEN), Others(), None),
    "totals": (TOTALS, reading(20, 380, None), Others(), BACK),
    "totals, one byte is missing": (TOTALS, reading(20, 381, None), Others(), None),
    "totals of a load": (UNKNOWN, reading(20, 480, None), Others(), BACK),
    "it was not listed before": (HIDDEN, reading(20, 380, {OTHER: 300}), Others(), BACK),
    "it was not listed, and a byte is missing": (
        HIDDEN, reading(20, 381, {OTHER: 300}), Others(), None,
    ),
    "a lost holder may still load": ({"not_before": 20.1}, reading(20, 380, SEEN), Others(), None),
    "its holder is fenced by now": ({"not_before": 20.0}, reading(20, 380, SEEN), Others(), BACK),
    "the reading before agrees": (
        {"last_used_bytes": 390}, reading(20, 380, SEEN), Others(), replace(BACK, resolved=True),
    ),
    "the reading before showed more": (
        {"last_used_bytes": 391}, reading(20, 380, SEEN), Others(), BACK,
    ),
    "the reading before showed less": (
        {"last_used_bytes": 369}, reading(20, 380, SEEN), Others(), BACK,
    ),
}  # fmt: skip
OVERDUE: dict[str, Case] = {
    "it keeps too much": (
        {"fenced_at": 20.0}, reading(20, 380, {OTHER: 300, ME: 61}), Others(),
        residue(61, Culprit(1, "p1", 61)),
    ),
    "it keeps too much and may use its lease": (
        {"fenced_at": 20.1}, reading(20, 380, {**SEEN, ME: 61}), Others(),
        residue(61, Culprit(1, "p1", 61), resolved=False),
    ),
    "a dead process is still listed": (
        DEAD, reading(90, 380, {**SEEN, ME: 11}), Others(),
        contested(11, Culprit(1, "p1", 11), resolved=False),
    ),
    "strangers and a holder grew": (
        {}, reading(20, 700, {9: 100, ME: 50, OTHER: 420, 8: 100}), Others(),
        contested(50, Culprit(2, "p2", 120), X8, X9),
    ),
    "without a baseline strangers are named": (
        NO_BASELINE, reading(20, 690, {ME: 50, OTHER: 400, 9: 100, 8: 100}), Others(),
        contested(50, X8, X9),
    ),
    "the rest of a dying process": (
        DEAD, reading(20.9 + DYING_S, 331, {OTHER: 300}), Others(), contested(0, resolved=False),
    ),
    "the driver would have freed a dead one": (
        DEAD, reading(21 + DYING_S, 331, {OTHER: 300}), Others(), contested(0),
    ),
    "a stranger took all but the tolerance": (
        DEAD, reading(20, 331, {OTHER: 300, 9: 1}), Others(), contested(0, Culprit(9, "p9", 1)),
    ),
    "bytes of a holder within its charge do not explain the rest": (
        DEAD, reading(20, 331, {OTHER: 301}), Others(),
        contested(0, Culprit(2, "p2", 1), resolved=False),
    ),
    "alive and not listed": ({}, reading(20, 920, {OTHER: 300}), Others(), residue(600)),
    "alive, and no process is listed": ({}, reading(20, 920, {}), Others(), residue(600)),
    "alive, not listed, without a baseline": (
        NO_BASELINE, reading(20, 920, {OTHER: 300}), Others(), residue(600),
    ),
    "alive, not listed, within its limit": (
        {}, reading(20, 480, {OTHER: 300, 9: 100}), Others(), contested(50, X9),
    ),
    "alive, not listed, one byte above it": (
        {}, reading(20, 481, {OTHER: 300, 9: 100}), Others(), residue(61),
    ),
    "a total, alive": ({}, reading(20, 481, None), Others(grown_bytes=50), residue(111)),
    "a total, alive and not fenced": (
        {"fenced_at": 30.0}, reading(20, 481, None), Others(), residue(161, resolved=False),
    ),
    "a list without its bytes": (
        {}, reading(20, 481, {ME: None, OTHER: 300}), Others(), residue(161),
    ),
    "a total, no baseline": (
        NO_BASELINE, reading(20, 481, None), Others(), Judgement(Verdict.UNVERIFIABLE, False, 50),
    ),
    "a total that the ledger explains without the dead": (
        DEAD, reading(20, 430, None), Others(), contested(0),
    ),
    "a total that it does not explain": (
        DEAD, reading(20, 431, None), Others(), contested(0, resolved=False),
    ),
    "it came back after all": ({}, reading(20, 380, SEEN), Others(), BACK),
}  # fmt: skip
CASES: dict[str, Case] = {
    **IN_TIME,
    **{
        name: ({**changes, **LATE}, shown, others, expected)
        for name, (changes, shown, others, expected) in OVERDUE.items()
    },
}


@pytest.mark.parametrize("case", CASES)
def test_a_reading_is_judged(case: str) -> None:
    """The ledger allows 470 bytes after the release, the baseline 370; 10 are the tolerance."""
    changes, shown, others, expected = CASES[case]
    world = World()
    world.lease(ME, 1000)
    world.lease(OTHER, 400)
    if changes.get("baseline", BEFORE) is None and shown.processes is not None:
        world.gpu.ledger.stowaways = {
            use.process: use for use in shown.processes if use.process.pid in (8, 9)
        }
    assert judge(replace(RELEASED, **changes), world.gpu.ledger, shown, others) == expected


@pytest.mark.parametrize(
    ("used", "others", "changes", "listed", "expected"),
    [
        (660, Others(), {}, None, BACK),
        (661, Others(), {}, None, None),
        (640, Others(), {}, None, BACK),  # exactly the tolerance more than its own is gone
        (639, Others(), {}, None, None),
        (639, Others(), {}, {ME: 50, OTHER: 300}, None),
        (639, Others(), LATE, None, BACK),
        (461, Others(loading_bytes=30), {}, None, None),
        (460, Others(loading_bytes=30), {}, None, BACK),  # all that is unattributed is gone
        (615, Others(left_bytes=25), {}, None, BACK),
        (614, Others(left_bytes=25), {}, None, None),
        (680, Others(), NO_BASELINE, None, BACK),
        (681, Others(), NO_BASELINE, None, None),
    ],
)
def test_bytes_of_nobody_that_may_have_gone_instead_hide_none_of_the_lease(
    used: int,
    others: Others,
    changes: dict[str, Any],
    listed: Mapping[int, int | None] | None,
    expected: Judgement | None,
) -> None:
    """200 bytes are unattributed, and 80 are of a stowaway."""
    world = World()
    world.lease(ME, 1000)
    world.lease(OTHER, 400)
    world.gpu.ledger.unattributed_bytes, world.gpu.ledger.stowaway_bytes = 200, 280
    released = replace(RELEASED, **{"baseline": reading(10.0, 1600, None), **changes})
    assert judge(released, world.gpu.ledger, reading(20, used, listed), others) == expected


# -- other processes
def left_and_pending(world: World) -> int:
    """Return what left since the baseline at 10 s: two verdicts, what is pending free (for 1 s),
    and two debts."""
    world.gpu.left.extend([(5.0, 7), (10.0, 3), (12.0, 11), (15.0, 13)])
    world.gpu.pending_free.give_up(process(9), 17, 9.5)
    world.gpu.pending_free.give_up(process(8), 5, 9.0)
    for pid, count in ((20, 90), (21, 45)):
        world.gpu.ledger.charge(LeaseId(f"L{pid}"), process(pid), count, count, 1.0)
        world.debt(pid, f"L{pid}", 15.0)
    world.debt(22, "L22", 15.0)  # without an account
    world.debt(ME, "L1", 15.0)
    return 11 + 13 + 17 + 90 + 45


def test_two_lists_tell_who_grew_and_who_shrank() -> None:
    world = World()
    then: dict[int, int | None] = {ME: 1000, 2: 300, 3: 500, 4: 60, 8: 40, 9: 80}
    now: dict[int, int | None] = {ME: 100, 2: 450, 3: 200, 5: 250, 6: 500, 9: 30, 12: 35}
    world.lease(ME, 1000)
    world.lease(2, 400)  # grew by 150, up to its charge
    world.lease(3, 500)  # shrank by 300
    world.lease(4, 60)  # its 60 are no longer listed
    world.lease(5, 200, state=LeaseState.LOADING)  # it loaded 200, and 50 beyond its charge
    world.lease(6, 600)  # listed now: 350 of its 500 were hidden before
    world.lease(12, 20)  # listed now, and hidden before
    world.lease(11, 5, ready_at=10.0)
    world.lease(7, 70, ready_at=11.0)  # neither list has it, and it loaded since
    world.lease(10, 30, ready_at=12.0)
    left_bytes = left_and_pending(world)
    baseline = reading(10.0, 1980 + 350 + DRIVER_BYTES, then)
    verification = replace(RELEASED, baseline=baseline)
    shown = reading(20.0, 2000, now)
    assert others_since(world.gpu, verification, shown, 1.0) == Others(
        grown_bytes=100 + 200 + 150 + 70 + 30, left_bytes=left_bytes + 300 + 60 + 40 + 50
    )


def loads(world: World) -> int:
    """Leases around a reading that began at 20 s. Return what is charged for loads that it may not
    have seen."""
    world.lease(ME, 1000)
    world.lease(2, 400, state=LeaseState.LOADING)
    world.lease(2, 150, name="L2b")  # 150 of its process are there
    world.lease(4, 60, ready_at=19.9)  # ready before it began
    world.lease(3, 500, ready_at=20.0)
    world.lease(5, 70, ready_at=21.0, state=LeaseState.REVOKING)
    world.gpu.ledger.retain(process(5), 80, 1.0)  # its context alone is larger
    for pid, count, ended_at in ((30, 8, 20.0), (31, 9, 21.0), (32, 6, 19.9)):
        world.gpu.ledger.charge(LeaseId(f"L{pid}"), process(pid), count, count, 1.0)
        world.debt(pid, f"L{pid}", ended_at)
    world.debt(2, "L2", 21.0)  # resident
    world.debt(33, None, 21.0)
    return 400 + 500 + 8 + 9


@pytest.mark.parametrize(
    ("shown", "seen"), [(None, 0), ({2: 350, 3: 100}, 200 + 100), ({2: 600, 3: 501}, 400 + 500)]
)
def test_a_total_tells_no_load_from_bytes_that_have_not_gone(
    shown: Mapping[int, int | None] | None, seen: int
) -> None:
    world = World()
    loading_bytes = loads(world) - seen
    now = reading(20.0, 2000, shown)
    without = replace(RELEASED, baseline=None)
    assert others_since(world.gpu, without, now, 1.0) == Others(loading_bytes=loading_bytes)
    before = replace(RELEASED, baseline=reading(10.0, 1320, None))
    assert others_since(world.gpu, before, now, 1.0) == Others(
        grown_bytes=400 + 500 + 60 + 70,
        left_bytes=550 + 8 + 9 + 6,
        loading_bytes=loading_bytes,
    )


def test_of_its_own_loads_a_process_is_no_other() -> None:
    world = World()
    world.lease(ME, 1000)
    world.lease(ME, 70, name="L1b", state=LeaseState.LOADING)
    world.lease(2, 30, ready_at=12.0)
    before = replace(RELEASED, baseline=reading(10.0, 1320, None))
    assert others_since(world.gpu, before, reading(20.0, 1320, None), 1.0) == Others(30, 0, 70)
