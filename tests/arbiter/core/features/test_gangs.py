"""Gangs: together or not at all, one after the other on a GPU, and what becomes of the rest when
one of them fails."""

from typing import Any

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import held
from vram_arbiter.arbiter.core.effects import Effect, Refuse
from vram_arbiter.arbiter.core.features import gang as gang_module
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

GIB = d.GIB
MIB = d.MIB


class Member:
    """One process with its lease in a gang."""

    def __init__(
        self, driver: CoreDriver, name: str, peak: float, steady: float | None = None, **spec: Any
    ) -> None:
        self.driver = driver
        self.who = driver.consumer(name)
        spec.setdefault("gang", ("g", 2))
        self.lease = self.who.acquire(int(peak * GIB), int((steady or peak) * GIB), **spec)

    @property
    def state(self) -> str:
        return self.driver.state(self.lease)

    def load(self, *measured: int) -> list[Effect]:
        return self.who.load(self.lease, *measured)


def pair(driver: CoreDriver, **spec: Any) -> tuple[Member, Member]:
    return Member(driver, "policy", 4, 3, **spec), Member(driver, "reward", 3, 2, **spec)


def states_of(*members: Member) -> list[str]:
    return [member.state for member in members]


def codes(driver: CoreDriver, member: Member) -> list[str]:
    return [push["error"]["code"] for push in driver.pushes("denied", member.lease)]


# -- gathering
def test_nobody_is_granted_before_all_have_come(driver: CoreDriver) -> None:
    a = Member(driver, "policy", 4, 3)
    driver.advance(10.0)
    assert a.state == "queued"
    view = driver.view(a.lease)
    assert view is not None
    assert (view["gang"], view["position"]) == (
        {"id": "g", "phase": "gathering", "members": 1, "size": 2},
        0,
    )
    (why,) = driver.why("policy")["leases"]
    assert (why["condition"], why["gang"]["members"], why["gang"]["size"]) == ("gathering", 1, 2)
    assert driver.gpu()["charged_bytes"] == 0
    held(driver, "other", 1)
    b = Member(driver, "reward", 2, 2)
    assert states_of(a, b) == ["loading", "queued"]
    assert driver.gpu()["charged_bytes"] == 1 * GIB + 3 * GIB + 2 * GIB + 1 * GIB, (
        "all have their bytes from now on"
    )


def test_they_load_one_after_the_other_and_nobody_comes_between(driver: CoreDriver) -> None:
    a, b = pair(driver)
    small = driver.consumer("small").acquire(GIB)
    driver.advance(5.0)
    assert states_of(a, b) == ["loading", "queued"]
    assert driver.why("reward")["leases"][0]["kept"] is True
    a.load()
    assert b.state == "loading", "in the same breath"
    driver.advance(1.0)
    assert driver.state(small) == "queued"
    assert driver.gpu()["blocked"]
    b.load()
    driver.until(lambda: driver.state(small) == "loading", limit_s=1.0)
    assert [n["phase"] for n in driver.notes("gang")] == ["loading", "complete"]
    assert driver.gpu()["charged_bytes"] == 3 * GIB + 2 * GIB + GIB
    assert "gang" not in (driver.view(a.lease) or {})


def test_members_may_be_of_one_process(driver: CoreDriver) -> None:
    who = driver.consumer("p")
    first = who.acquire(3 * GIB, 2 * GIB, gang=("g", 2))
    second = who.acquire(3 * GIB, 2 * GIB, gang=("g", 2))
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    who.hold(2 * GIB)
    who.ready(first)
    who.hold(4 * GIB)
    who.ready(second)
    assert (driver.state(first), driver.state(second)) == ("held", "held")
    assert driver.gpu()["charged_bytes"] == 4 * GIB


def test_one_too_many_and_another_size_are_refused(driver: CoreDriver) -> None:
    Member(driver, "a", 1)
    x = driver.consumer("x")
    assert refusal(x.try_acquire(GIB, gang=("g", 3))).code == "bad_request"
    Member(driver, "b", 1)
    assert "have come" in refusal(x.try_acquire(GIB, gang=("g", 2))).message


def test_what_can_never_fit_together_is_said_to_all_at_once(driver: CoreDriver) -> None:
    a = Member(driver, "a", 5)
    effects = driver.consumer("b").try_acquire(4 * GIB, gang=("g", 2))
    assert refusal(effects).code == "vram_insufficient"
    assert refusal(effects).details["needed_bytes"] == 9 * GIB
    assert codes(driver, a) == ["vram_insufficient"]
    assert a.state == "over"


def test_a_member_that_can_never_fit_alone_breaks_the_gang(driver: CoreDriver) -> None:
    a = Member(driver, "a", 5)
    assert (
        refusal(driver.consumer("b").try_acquire(9 * GIB, gang=("g", 2))).code
        == "vram_insufficient"
    )
    assert codes(driver, a) == ["gang_broken"]
    assert (
        refusal(driver.consumer("b").try_acquire(9 * GIB, gang=("h", 2))).code
        == "vram_insufficient"
    )


def test_serial_loading_counts_only_the_largest_headroom(driver: CoreDriver) -> None:
    """4 + 3.6 at their peaks do not fit on 7.7, but 3 + 2.6 and one headroom of 1 do."""
    a, b = Member(driver, "a", 4, 3), Member(driver, "b", 3.6, 2.6)
    assert states_of(a, b) == ["loading", "queued"]
    a.load()
    b.load()
    assert states_of(a, b) == ["held", "held"]


@pytest.mark.parametrize("end", ["cancel", "die", "leave", "timeout"])
def test_one_that_gives_up_while_waiting_breaks_it(driver: CoreDriver, end: str) -> None:
    held(driver, "busy", 6)[0].use_begin(LeaseId("L1-1"))
    a, b = (
        Member(driver, "a", 4, 3),
        Member(driver, "b", 3, 2, wait_timeout_s=5.0 if end == "timeout" else None),
    )
    assert states_of(a, b) == ["queued", "queued"]
    if end == "cancel":
        b.who.cancel(b.lease)
    elif end == "die":
        b.who.die()
    elif end == "leave":
        b.who.leave("dropped")
    else:
        driver.advance(5.1)
    assert states_of(a, b) == ["over", "over"]
    assert "gang_broken" in codes(driver, a) + codes(driver, b)
    (note,) = [n for n in driver.notes("gang") if n["phase"] == "broken"]
    assert b.lease in note["reason"] or a.lease in note["reason"]


# -- waiting
def test_victims_are_asked_only_if_the_whole_gang_then_fits(driver: CoreDriver) -> None:
    idle, first = held(driver, "idle", 3)
    held(driver, "pinned", 3, evictable=False)
    a, b = Member(driver, "a", 2), Member(driver, "b", 2)
    assert driver.state(first) == "revoking"
    assert states_of(a, b) == ["queued", "queued"]
    assert driver.why("a")["leases"][0]["wait"] == "making_room"
    idle.unload(first)
    driver.until(lambda: a.state == "loading")
    assert driver.notes("granted")[-1]["evicted"] == ["idle"]


def test_nobody_is_evicted_for_a_gang_that_would_not_fit_all_the_same(driver: CoreDriver) -> None:
    _, idle = held(driver, "idle", 2)
    busy, lease = held(driver, "busy", 5, priority=90)
    busy.use_begin(lease)
    a, b = Member(driver, "a", 2), Member(driver, "b", 2)
    driver.advance(3.0)
    assert driver.state(idle) == "held"
    assert states_of(a, b) == ["queued", "queued"]
    assert driver.why("a")["leases"][0]["wait"] == "no_victim"
    busy.use_end(lease)
    assert driver.state(lease) == "revoking"
    assert driver.state(idle) == "held", "the cheapest that covers it"


def test_a_gang_ages_from_its_first_member_at_its_lowest_priority(driver: CoreDriver) -> None:
    busy, lease = held(driver, "busy", 7)
    busy.use_begin(lease)
    a = Member(driver, "a", 2, priority=90)
    driver.advance(1.0)
    between = driver.consumer("between").acquire(2 * GIB)
    driver.advance(1.0)
    b = Member(driver, "b", 2, priority=50)
    assert driver.view(a.lease)["position"] == 1  # type: ignore[index]
    assert driver.view(between)["position"] == 3  # type: ignore[index]
    del b


def test_nobody_of_a_gang_is_backfilled_alone(driver: CoreDriver) -> None:
    busy, lease = held(driver, "busy", 4)
    busy.use_begin(lease)
    driver.consumer("big").acquire(6 * GIB, priority=60)
    a, b = Member(driver, "a", 1), Member(driver, "b", 0.5)
    driver.advance(2.0)
    assert states_of(a, b) == ["queued", "queued"]
    (why,) = driver.why("b")["leases"]
    assert (why["condition"], why["gang"]["id"], why["ahead"], why["position"]) == (
        "behind",
        "g",
        "big",
        2,
    )


def test_measured_memory_that_is_not_there_keeps_a_gang_waiting(driver: CoreDriver) -> None:
    person, lease = held(driver, "other", 3)
    driver.device.silent = True
    driver.advance(3.0)
    a, b = Member(driver, "a", 2), Member(driver, "b", 2)
    assert states_of(a, b) == ["queued", "queued"], "the reading is too old"
    driver.device.silent = False
    driver.until(lambda: a.state == "loading", limit_s=3.0)
    del person, lease


# -- several GPUs
def test_a_model_over_two_gpus_is_a_gang_of_two_leases() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    who = driver.consumer("p")
    first = who.acquire(6 * GIB, gang=("g", 2), gpu="0")
    second = who.acquire(6 * GIB, gang=("g", 2), gpu="1")
    assert (driver.state(first), driver.state(second)) == ("loading", "loading"), (
        "serial per GPU only"
    )
    who.load(first)
    who.load(second)
    assert [n["phase"] for n in driver.notes("gang")] == ["loading", "complete"]


def test_members_that_may_be_anywhere_are_spread_so_that_all_fit() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    a = Member(driver, "a", 6)
    b = Member(driver, "b", 2, gpu="0")
    assert states_of(a, b) == ["loading", "loading"]
    assert driver.view(a.lease)["gpu"] == "GPU-1"  # type: ignore[index]


def test_both_gpus_are_emptied_or_none() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    idle, first = held(driver, "idle", 5, gpu="0")
    busy, second = held(driver, "busy", 5, gpu="1", priority=90)
    busy.use_begin(second)
    a, b = Member(driver, "a", 5, gpu="0"), Member(driver, "b", 5, gpu="1")
    driver.advance(3.0)
    assert driver.state(first) == "held"
    busy.use_end(second)
    assert (driver.state(first), driver.state(second)) == ("revoking", "revoking")
    idle.unload(first)
    driver.advance(1.0)
    assert states_of(a, b) == ["queued", "queued"], "one GPU is free, the other is not"
    busy.unload(second)
    driver.until(lambda: states_of(a, b) == ["loading", "loading"])


def test_an_exclusive_member_wants_a_gpu_of_its_own() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    a = Member(driver, "a", 2, exclusive=True)
    b = Member(driver, "b", 2)
    assert states_of(a, b) == ["loading", "loading"]
    assert driver.view(a.lease)["gpu"] != driver.view(b.lease)["gpu"]  # type: ignore[index]
    single = CoreDriver(8 * GIB)
    Member(single, "a", 2, exclusive=True)
    assert (
        refusal(single.consumer("b").try_acquire(2 * GIB, gang=("g", 2))).code
        == "vram_insufficient"
    )


def test_a_search_without_end_is_cut_off(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(gang_module, "SEARCH_MAX", 1)
    driver = CoreDriver(8 * GIB, gpus=2)
    Member(driver, "a", 6)
    assert (
        refusal(driver.consumer("b").try_acquire(6 * GIB, gang=("g", 2))).code
        == "vram_insufficient"
    )


# -- breaking
def test_a_member_that_fails_to_load_breaks_it_and_who_waits_is_denied(driver: CoreDriver) -> None:
    a, b = pair(driver)
    a.who.release(a.lease)
    assert codes(driver, b) == ["gang_broken"]
    error = driver.pushes("denied", b.lease)[0]["error"]
    assert error["details"]["gang"] == "g"
    assert a.lease in error["message"]
    driver.advance(1.0)
    assert driver.gpu()["charged_bytes"] == 0


def test_who_holds_keeps_its_lease_when_the_gang_breaks(driver: CoreDriver) -> None:
    a, b = pair(driver)
    a.load()
    b.who.die()
    assert states_of(a, b) == ["held", "over"]
    driver.advance(1.0)
    assert driver.gpu()["charged_bytes"] == 3 * GIB
    driver.consumer("w").acquire(7 * GIB)
    assert a.state == "revoking", "ordinary from now on"


def test_a_member_that_waits_for_its_turn_and_gives_up_gives_its_bytes_back(
    driver: CoreDriver,
) -> None:
    a, b = pair(driver)
    b.who.cancel(b.lease)
    assert states_of(a, b) == ["loading", "over"]
    assert driver.gpu()["charged_bytes"] == 4 * GIB
    a.load()
    assert a.state == "held"


def test_nobody_of_an_unfinished_gang_is_evicted(driver: CoreDriver) -> None:
    a, b = pair(driver)
    a.load()
    driver.device.set(ProcessKey(9, 9), 5 * GIB, driver.now)
    driver.advance(2.0)
    assert driver.gpu()["pressure_bytes"] > 0
    assert states_of(a, b) == ["held", "loading"]
    b.load()
    driver.advance(1.5)
    assert "revoking" in states_of(a, b), "complete: relief of pressure as for anybody"


def test_a_member_that_takes_more_than_it_said_breaks_what_no_longer_fits() -> None:
    driver = CoreDriver(8 * GIB)
    a, b = Member(driver, "a", 4.2, 4), Member(driver, "b", 3.6, 3)
    a.load(int(4.2 * GIB))
    assert codes(driver, b) == ["gang_broken"]
    assert a.state == "held"


def test_somebody_who_grew_meanwhile_is_asked_to_leave_or_the_gang_breaks(
    driver: CoreDriver,
) -> None:
    for evictable in (True, False):
        driver = CoreDriver(8 * GIB)
        other, lease = held(driver, "other", 1, evictable=evictable)
        a, b = Member(driver, "a", 3.3, 3.2), Member(driver, "b", 3.3, 3.2)
        other.hold(GIB + 240 * MIB)
        a.who.hold(int(3.2 * GIB))
        driver.advance(1.1)
        a.who.ready(a.lease)
        driver.advance(0.01)
        if evictable:
            assert (driver.state(lease), b.state) == ("revoking", "queued")
            driver.advance(1.0)
            other.unload(lease)
            driver.until(lambda: b.state == "loading")  # noqa: B023 - called at once
        else:
            assert codes(driver, b) == ["gang_broken"]


def test_an_unreadable_gpu_makes_the_next_member_wait(driver: CoreDriver) -> None:
    a, b = pair(driver)
    driver.device.failing = "NVML_ERROR_UNKNOWN"
    driver.advance(1.1)
    a.load()
    driver.advance(1.0)
    assert b.state == "queued"
    driver.device.failing = ""
    driver.until(lambda: b.state == "loading", limit_s=3.0)


def test_a_grant_that_cannot_be_written_breaks_it(driver: CoreDriver) -> None:
    a = Member(driver, "a", 4, 3)
    driver.journal_failing = "disk full"
    effects = driver.consumer("b").try_acquire(2 * GIB, gang=("g", 2))
    driver.journal_failing = ""
    assert a.state == "over"
    assert driver.gpu()["charged_bytes"] == 0
    del effects


def test_a_gathering_gang_is_no_deadlock(driver: CoreDriver) -> None:
    job, lease = held(driver, "job", 3)
    job.use_begin(lease)
    first = job.acquire(GIB, gang=("g", 2))
    assert driver.state(first) == "queued"
    second = driver.consumer("x").acquire(GIB, gang=("g", 2))
    assert driver.state(first) == "loading"
    del second


# -- restarts
def again(driver: CoreDriver, member: Member, nonce: str = "n1") -> list[Effect]:
    """The client asks again by its nonce, as it does for whatever it waits for."""
    return member.who.try_acquire(2 * GIB, 2 * GIB, gang=("g", 2), nonce=nonce)


def test_a_gang_that_was_loading_is_completed_after_a_restart(driver: CoreDriver) -> None:
    a, b = Member(driver, "a", 3, 2), Member(driver, "b", 2)
    token = a.who.token(a.lease)
    driver.restart()
    a.who.connect()
    b.who.connect()
    answer(a.who.reattach(a.lease, token, held=False))
    lease = LeaseId(answer(again(driver, b))["lease"]["lease_id"])
    driver.advance(0.5)
    assert (a.state, driver.state(lease)) == ("loading", "queued"), "serial as ever"
    a.load()
    driver.until(lambda: driver.state(lease) == "loading")
    driver.advance(30.0)
    b.who.hold(2 * GIB)
    b.who.ready(lease)
    assert [n["phase"] for n in driver.notes("gang")][-1] == "complete"
    assert driver.journal[f"lease:{a.lease}"].get("gang") is None


def test_a_gang_of_which_not_all_come_back_is_broken_in_time(driver: CoreDriver) -> None:
    a = Member(driver, "a", 3, 2, gang=("g", 3))
    b, c = Member(driver, "b", 1, gang=("g", 3)), Member(driver, "c", 1, gang=("g", 3))
    assert states_of(a, b, c) == ["loading", "queued", "queued"]
    token = a.who.token(a.lease)
    driver.restart()
    for member in (a, b):
        member.who.connect()
    answer(a.who.reattach(a.lease, token, held=False))
    a.load()
    lease = LeaseId(answer(b.who.try_acquire(GIB, gang=("g", 3)))["lease"]["lease_id"])
    driver.advance(d.LEASE_TTL_S + d.FENCE_GRACE_S + 1.0)
    assert (a.state, driver.state(lease)) == ("held", "over")
    assert driver.pushes("denied", lease)[0]["error"]["code"] == "gang_broken"
    driver.consumer("w").acquire(7 * GIB)
    assert a.state == "revoking"


def test_a_gang_that_was_all_granted_is_complete_when_the_last_is_ready_after_a_restart(
    driver: CoreDriver,
) -> None:
    a, b = pair(driver)
    a.load()
    tokens = [member.who.token(member.lease) for member in (a, b)]
    driver.restart()
    for member, token, done in zip((a, b), tokens, (True, False), strict=True):
        member.who.connect()
        answer(member.who.reattach(member.lease, token, held=done))
    b.load()
    assert states_of(a, b) == ["held", "held"]
    assert [n["phase"] for n in driver.notes("gang")][-1] == "complete"
    driver.advance(60.0)
    assert states_of(a, b) == ["held", "held"]


def test_refusals_of_a_gang_reach_who_has_only_just_asked(driver: CoreDriver) -> None:
    Member(driver, "a", 5)
    effects = driver.consumer("b").try_acquire(4 * GIB, gang=("g", 2))
    assert [type(e) for e in effects if isinstance(e, Refuse)] == [Refuse]


def test_memory_that_nobody_can_explain_is_not_free_for_a_gang(driver: CoreDriver) -> None:
    driver.device.lists_processes = False
    other, lease = held(driver, "other", 1)
    driver.device.set(ProcessKey(9, 9), 4 * GIB, driver.now)  # it appears while somebody unloads
    other.unloading(lease)
    driver.advance(1.5)
    a, b = Member(driver, "a", 3), Member(driver, "b", 2)
    driver.advance(1.5)
    assert states_of(a, b) == ["queued", "queued"]
    assert driver.blocked() == "not_free"
    driver.device.set(ProcessKey(9, 9), 0, driver.now)
    driver.until(lambda: a.state == "loading", limit_s=2.0)


def test_an_idle_gpu_beside_a_busy_one_is_no_place_for_half_a_gang() -> None:
    """Two exclusive members and one GPU that can be emptied: the other one's holder is of higher
    priority."""
    driver = CoreDriver(8 * GIB, gpus=2)
    busy, lease = held(driver, "busy", 2, gpu="1", priority=90)
    busy.use_begin(lease)
    _, idle = held(driver, "idle", 2, gpu="0")
    a, b = Member(driver, "a", 2, exclusive=True), Member(driver, "b", 2, exclusive=True)
    driver.advance(3.0)
    assert states_of(a, b) == ["queued", "queued"]
    assert driver.state(idle) == "held"
    busy.use_end(lease)
    assert (driver.state(idle), driver.state(lease)) == ("revoking", "revoking")


def test_a_gang_goes_ahead_of_a_waiter_for_which_another_gpu_is_being_emptied() -> None:
    """Regression: only the head of the queue was asked for its turn, so a gang waited although its
    room was free."""
    driver = CoreDriver(8 * GIB, gpus=2)
    busy, lease = held(driver, "busy", 5, gpu="0", priority=90)
    busy.use_begin(lease)
    _, idle = held(driver, "idle", 5, gpu="1")
    first = driver.consumer("first").acquire(7 * GIB)
    assert (driver.state(idle), driver.state(first)) == ("revoking", "queued")
    a, b = Member(driver, "a", 1, gpu="0"), Member(driver, "b", 1, gpu="0")
    driver.advance(0.1)
    assert states_of(a, b) == ["loading", "queued"]
    gang = driver.view(b.lease)["gang"]
    assert gang == {"id": "g", "phase": "loading", "members": 2, "size": 2}
