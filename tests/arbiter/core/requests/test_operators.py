"""What an operator does by hand: it is kept with who and why, and no rule for holders gets
weaker."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.engine_state import state_of
from tests.support.scenes import give_back, held, in_use
from vram_arbiter.arbiter.core.effects import Effect, Note, Signal
from vram_arbiter.arbiter.core.events import SettingsChanged
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.wire.notes import OperatorNote

BY = "ops (uid 0, pid 7)"


@pytest.fixture
def ops(driver: CoreDriver) -> Consumer:
    return driver.consumer("ops")


def order_of(ops: Consumer, action: Any, target: str = "", reason: str = "test") -> list[Effect]:
    return ops.order(action, target, reason, BY)


def noted(effects: list[Effect]) -> dict[str, Any]:
    (note,) = [e for e in effects if isinstance(e, Note) and e.kind == "operator"]
    return words.event(note)


def orders(effects: list[Effect]) -> list[OperatorNote]:
    """What the history says of orders."""
    notes = [e for e in effects if isinstance(e, Note)]
    return [note.body for note in notes if isinstance(note.body, OperatorNote)]


# -- evict
def test_an_evicted_holder_in_use_finishes_first(driver: CoreDriver, ops: Consumer) -> None:
    det, lease = in_use(driver, "det", 5)
    effects = order_of(ops, "evict", "det", "maintenance")
    assert answer(effects)["state"] == "revoking"
    assert noted(effects) | {
        "action": "evict",
        "by": BY,
        "reason": "maintenance",
        "uses": 1,
    } == noted(effects)
    (revoke,) = driver.pushes("revoke", lease)
    assert (revoke["cause"], revoke["order"]) == ("operator", {"by": BY, "reason": "maintenance"})
    assert refusal(det.unloading(lease)).code == "bad_state"
    token = det.token(lease)
    other = driver.consumer("other")
    order = {"cause": "operator", "order": {"by": BY, "reason": "maintenance"}}
    early = refusal(other.use_begin(lease, token=token))
    assert (early.code, early.details["revoked"]) == ("lease_revoking", order)
    det.use_end(lease)
    give_back(driver, det, lease)
    late = refusal(other.use_begin(lease, token=token))
    assert (late.code, late.details["state"], late.details["revoked"]) == (
        "bad_state",
        "released",
        order,
    )
    assert driver.notes("verified")[-1]["verdict"] == "verified"


def test_a_holder_that_leaves_for_a_waiter_hears_of_the_operator(
    driver: CoreDriver, ops: Consumer
) -> None:
    """`vramctl run` lets a waiter of its own priority wait, and ends its program for an
    operator."""
    det, lease = in_use(driver, "det", 5)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: bool(driver.pushes("revoke", lease)))
    det.ack(lease, None)
    order_of(ops, "evict", lease, "maintenance")
    first, *_, last = driver.pushes("revoke", lease)
    assert (first["priority"], first["cause"], first["wanted_by"]) == (d.PRIORITY, "waiter", "vlm")
    assert "priority" not in last
    assert (last["cause"], last["order"]) == ("operator", {"by": BY, "reason": "maintenance"})


def test_the_push_of_a_repeated_evict_puts_off_no_other(driver: CoreDriver, ops: Consumer) -> None:
    """An operator who repeats an evict all the time would keep the ladder from its own pushes."""
    _, lease = in_use(driver, "det", 5)
    order_of(ops, "evict", lease)
    driver.advance(0.2)
    order_of(ops, "evict", lease)
    assert len(driver.pushes("revoke", lease)) == 2
    driver.advance(0.06)
    assert len(driver.pushes("revoke", lease)) == 3, "a quarter of a second after the first"


# -- who is meant
@pytest.mark.parametrize("evictable", [True, False])
def test_every_refusal_says_what_to_do(driver: CoreDriver, ops: Consumer, evictable: bool) -> None:
    _, lease = held(driver, "det", 5, evictable=evictable)
    waiter = driver.consumer("w").acquire(5 * GIB) if evictable else lease
    alive = refusal(order_of(ops, "release_dead", lease))
    assert "heard from 0.0 s ago" in alive.message, "it said -0.0 where the lease was just renewed"
    assert (alive.details["problem"], alive.details.get("evictable", True)) == (
        "holder_lives",
        evictable,
    )
    for action, target in (
        ("unpin", lease), ("evict", waiter), ("release_dead", waiter), ("pin", "nobody"),
        ("unpin", "L9-9"),
    ):  # fmt: skip
        refused = refusal(order_of(ops, action, target))
        assert refused.message, action
        assert refused.hint, action


# -- the dead
def test_a_holder_that_did_not_come_back_after_a_restart_needs_no_patience(
    driver: CoreDriver, ops: Consumer
) -> None:
    """Regression: recovery ended with the verdict on a declared-dead holder and not with its lease,
    so all requests waited."""
    det, lease = held(driver, "det", 5, ttl_s=600.0)
    driver.restart()
    ops.connect()
    order_of(ops, "release_dead", lease, "it was a crash")
    assert driver.status()["phase"] == "serving", "its bytes are a debt: others wait for nothing"
    assert (driver.state(lease), driver.gpu()["charged_bytes"]) == ("over", 5 * GIB)
    det.hold(0)
    driver.until(lambda: driver.gpu()["charged_bytes"] == 0, limit_s=0.1)
    assert f"lease:{lease}" not in driver.journal


@pytest.mark.parametrize("restarts", [1, 2])
def test_who_is_given_up_and_keeps_its_bytes_has_its_lease_until_it_fences_itself(
    driver: CoreDriver, restarts: int
) -> None:
    """A frozen process wakes up and goes on for as long as it believes in its lease; what it keeps
    until then is no mere residue."""
    ops = driver.consumer("ops")
    det, lease = held(driver, "det", 5, ttl_s=30.0)
    driver.restart()
    ops.connect()
    order_of(ops, "release_dead", lease, "frozen")
    if restarts == 2:
        driver.restart(epoch=3)
    waiter = driver.consumer("policy").acquire(1 * GIB, exclusive=True)
    other = driver.consumer("vlm").acquire(1 * GIB)
    driver.until(lambda: bool(driver.notes("verified")), limit_s=16.0)
    assert [(note["verdict"], note["resolved"]) for note in driver.notes("verified")] == [
        ("residue", False)
    ]
    (blocker,) = driver.why("policy")["leases"][0]["blockers"]
    assert (blocker["condition"], blocker["pid"]) == ("debt_kept", det.process.pid)
    assert driver.state(waiter) == "queued"
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=26.0)
    assert driver.notes("verified")[-1]["resolved"] is True
    assert driver.gpu()["charged_bytes"] == 6 * GIB
    assert driver.state(other) == "queued"


@pytest.mark.parametrize("lists", [True, False])
@pytest.mark.parametrize("charged", [500 * MIB, 2 * GIB])
def test_who_is_given_up_and_is_too_small_to_be_seen_has_its_lease_until_it_fences_itself(
    driver: CoreDriver, ops: Consumer, charged: int, *, lists: bool
) -> None:
    """What it holds beyond its context is less than a reading can be off: its bytes are "gone"
    while all of them are there. So it is where a lease of 2 GiB put no more than that on the GPU:
    what counts is what a reading could see leave, not what is charged."""
    driver.device.lists_processes = lists
    det, lease = held(driver, "det", charged / GIB, residue_bytes=450 * MIB, ttl_s=10.0)
    det.hold(500 * MIB)
    driver.restart()
    ops.connect()
    order_of(ops, "release_dead", lease, "frozen")
    waiter = driver.consumer("policy").acquire(1 * GIB, exclusive=True)
    took = driver.until(lambda: driver.state(waiter) == "loading")
    assert 14.9 <= took <= 15.1, "its ttl, and the grace"
    assert det.process in driver.device.held


def test_who_is_given_up_while_it_loads_may_load_on_until_it_fences_itself(
    driver: CoreDriver, ops: Consumer
) -> None:
    """Regression: an exclusive lease was granted beside a frozen holder that still believed in its
    lease (seed 697)."""
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, ttl_s=60.0)
    driver.until(lambda: driver.state(lease) == "loading")
    driver.advance(45.0)
    order_of(ops, "release_dead", lease, "frozen")
    given_up = driver.now
    driver.until(lambda: driver.gpu()["charged_bytes"] == 0)
    assert 20.0 <= driver.now - given_up <= 20.2, "15 s of its time, 5 s of grace"


def test_the_history_names_the_operator_that_evicts(driver: CoreDriver, ops: Consumer) -> None:
    """Regression: the event `revoke_asked` of an operator's order had the reason " needs the
    room"."""
    _, lease = held(driver, "det", 5)
    order_of(ops, "evict", lease, "service")
    (note,) = driver.notes("revoke_asked")
    assert note["reason"] == f"evicted by {BY}: service"
    assert note["order"] == {"by": BY, "reason": "service"}


# -- kill
def signals(effects: list[Effect]) -> list[tuple[ProcessKey, str]]:
    return [(effect.process, effect.kind) for effect in effects if isinstance(effect, Signal)]


def test_a_stuck_holder_is_told_to_end_and_killed_when_asked_twice(
    driver: CoreDriver, ops: Consumer
) -> None:
    """Its own use may be what is stuck: it protects it from an eviction, not from a person."""
    det, lease = in_use(driver, "det", 5)
    for signal in ("term", "kill", "kill"):
        effects = order_of(ops, "kill", "det", "it hangs")
        assert signals(effects) == [(det.process, signal)]
        assert answer(effects)["state"] == "held"
    told = driver.notes("signalled")[0]
    assert (told["signal"], told["pid"]) == ("term", det.process.pid)
    assert (told["by"], told["reason"]) == (BY, "it hangs")
    det.die()
    assert driver.state(lease) == "over"
    other, _ = held(driver, "det", 5)
    assert signals(order_of(ops, "kill", "det")) == [(other.process, "term")]


def test_no_process_is_killed_in_the_middle_of_anothers_use(
    driver: CoreDriver, ops: Consumer
) -> None:
    """A robot may be moving: the runner uses the policy's lease, and holds one to render with."""
    policy, lease = held(driver, "policy", 4)
    runner, rendering = held(driver, "runner", 1)
    runner.use_begin(lease, "goal", policy.token(lease))
    for name in ("policy", "runner"):
        effects = order_of(ops, "kill", name)
        refused = refusal(effects)
        assert (refused.code, refused.details["problem"]) == ("bad_state", "others_use")
        assert signals(effects) == []
    runner.use_end(lease, "goal", policy.token(lease))
    runner.use_begin(rendering)
    assert signals(order_of(ops, "kill", "runner")) == [(runner.process, "term")]
    assert signals(order_of(ops, "kill", "policy")) == [(policy.process, "term")]


def test_a_changed_setting_leaves_the_others_as_they_are(driver: CoreDriver) -> None:
    driver.post(SettingsChanged({"waiters_max": 3}))
    assert state_of(driver.arbiter).settings == replace(driver.settings, waiters_max=3)
