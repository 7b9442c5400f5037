"""What clients ask for: exact effects, and every refusal with its code. A refused request changes
nothing."""

from typing import Any

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import held, shown
from vram_arbiter.arbiter.core.effects import JournalPut, Note, Push, Reply, Sample
from vram_arbiter.arbiter.core.events import Asked
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ClientId, LeaseId, RequestId, Token
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.notes import GrantedNote, QueuedNote
from vram_arbiter.schemas.wire.requests import Acquire


def kinds(effects: list[Any]) -> list[str]:
    return [
        f"{type(e).__name__}:{e.kind}" if isinstance(e, Note) else type(e).__name__ for e in effects
    ]


# -- acquire
def test_a_grant_is_journalled_before_it_is_told(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    effects = det.try_acquire(5 * GIB)
    assert kinds(effects) == ["JournalPut", "Reply", "Note:granted"]
    put, reply, note = effects
    assert isinstance(put, JournalPut)
    assert isinstance(reply, Reply)
    assert isinstance(note, Note)
    assert put.key == "lease:L1-1"
    assert isinstance(put.record, LeaseRecord)
    assert (put.record.state, put.record.token) == ("loading", (1, 2))
    told = answer(effects)
    assert (told["state"], told["lease"]["token"]) == ("loading", [1, 2])
    assert told["lease"]["charge_bytes"] == 5 * GIB
    assert isinstance(note.body, GrantedNote)
    assert note.body.evicted == ()


def test_who_has_to_wait_is_told_why_and_hears_of_the_grant_by_push(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    first = det.acquire(5 * GIB)
    effects = vlm.try_acquire(3 * GIB)
    assert kinds(effects) == ["Note:queued", "Reply"]
    assert answer(effects)["state"] == "queued"
    assert answer(effects)["lease"]["token"] is None
    assert answer(effects)["lease"]["position"] == 1
    assert isinstance(effects[0], Note)
    assert isinstance(effects[0].body, QueuedNote)
    block = effects[0].body.block
    assert block is not None
    assert (block.code, block.names) == (Block.LOADING, ("det",))
    waiting = LeaseId(answer(effects)["lease"]["lease_id"])
    assert kinds(det.release(first)) == ["JournalPut", "Note:released", "Reply", "Sample"]
    driver.until(lambda: driver.state(waiting) == "loading")
    (granted,) = driver.pushes("granted")
    assert granted["lease"]["lease_id"] == waiting
    tail = kinds(driver.effects)
    assert tail.index("JournalPut", tail.index("Note:queued")) < tail.index("Push"), "journal first"


def test_the_same_nonce_is_the_same_lease(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    first = det.acquire(5 * GIB, nonce="again")
    assert det.acquire(5 * GIB, nonce="again") == first
    assert det.acquire(1 * GIB, nonce="again") == first, "the spec of a repeat does not matter"
    assert vlm.acquire(1 * GIB, nonce="again") != first, "another process, another lease"
    second = det.acquire(1 * GIB, nonce="more")
    assert answer(det.try_acquire(1 * GIB, nonce="more"))["state"] == "queued"
    det.cancel(second)
    assert refusal(det.try_acquire(1 * GIB, nonce="more")).code == "cancelled"
    det.release(first)
    driver.advance(1.0)
    assert refusal(det.try_acquire(1 * GIB, nonce="again")).code == "bad_state"


def test_what_can_never_fit_fails_at_once(driver: CoreDriver) -> None:
    refused = refusal(driver.consumer("big").try_acquire(8 * GIB))
    assert refused.code == "vram_insufficient"
    assert refused.details == {
        "consumer": "big",
        "needed_bytes": 8 * GIB,
        "declared_bytes": 8 * GIB,
        "capacity_bytes": 8 * GIB,
        "reserve_bytes": d.RESERVE_BYTES,
    }


@pytest.mark.parametrize("spec", [{}, {"exclusive": True}])
def test_beside_a_pinned_holder_a_request_waits(driver: CoreDriver, spec: dict[str, Any]) -> None:
    """A pinned program ends one day. Two `vramctl run --vram 6GiB` are no reason to say that the
    second can never fit: its own timeout counts."""
    pin, big = driver.consumer("pin"), driver.consumer("big")
    lease = pin.acquire(6 * GIB, evictable=False, **spec)
    pin.load(lease)
    bounded = big.acquire(6 * GIB, wait_timeout_s=5.0, **spec)
    second = driver.consumer("second").acquire(6 * GIB, **spec)
    driver.advance(4.0)
    assert (driver.state(bounded), driver.state(second)) == ("queued", "queued")
    (blocker,) = driver.why("big")["leases"][0]["blockers"]
    assert (blocker["consumer"], blocker["condition"]) == ("pin", "pinned")
    driver.advance(2.0)
    (denied,) = driver.pushes("denied", bounded)
    assert denied["error"]["code"] == "wait_timeout"
    assert "pin (is pinned)" in denied["error"]["message"]
    assert driver.pushes("revoke", lease) == []
    pin.unload(lease)
    driver.until(lambda: driver.state(second) == "loading")


def test_an_unknown_gpu_is_named(driver: CoreDriver) -> None:
    refused = refusal(driver.consumer("det").try_acquire(1 * GIB, gpu="7"))
    assert (refused.code, refused.details["known"]) == ("unknown_gpu", ["GPU-0"])
    assert driver.consumer("a").acquire(1 * GIB, gpu="0")
    assert driver.consumer("b").acquire(1 * GIB, gpu="GPU-0")


def test_a_connection_without_hello_is_refused(driver: CoreDriver) -> None:
    spec = driver.consumer("det").spec(1 * GIB)
    event = Asked(ClientId("nobody"), RequestId(1), Acquire("n", spec))
    assert refusal(driver.post(event)).code == "unknown_session"


def test_limits_have_names() -> None:
    driver = CoreDriver(
        8 * GIB, settings={"waiters_max": 1, "leases_per_client_max": 2, "uses_per_lease_max": 1}
    )
    a, b = driver.consumer("a"), driver.consumer("b")
    lease = a.acquire(1 * GIB)
    a.acquire(1 * GIB)
    assert refusal(b.try_acquire(1 * GIB)).details["limit"] == "waiters_max"
    a.load(lease)
    assert refusal(a.try_acquire(1 * GIB)).details["limit"] == "leases_per_client_max"
    a.use_begin(lease, "u1")
    assert refusal(a.use_begin(lease, "u2")).details["limit"] == "uses_per_lease_max"


def test_a_wait_has_a_bound_and_says_who_was_in_the_way(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    held = det.acquire(5 * GIB, evictable=False)
    det.load(held)
    driver.device.failing = "probe died"
    driver.advance(1.5)
    lease = vlm.acquire(2 * GIB, wait_timeout_s=5.0)
    driver.advance(4.9)
    assert driver.state(lease) == "queued"
    driver.advance(0.2)
    assert driver.state(lease) == "over"
    (denied,) = driver.pushes("denied", lease)
    assert denied["error"]["code"] == "wait_timeout"
    assert "probe died" in denied["error"]["details"]["why"]["text"]


# -- cancel
def test_cancel_gives_up_a_wait_and_may_be_repeated(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    held = det.acquire(5 * GIB)
    queued = vlm.acquire(5 * GIB)
    assert refusal(det.cancel(queued)).code == "not_permitted"
    assert refusal(det.cancel(held)).code == "bad_state"
    assert refusal(det.cancel(LeaseId("L9-9"))).code == "unknown_lease"
    assert answer(vlm.cancel(queued)) == {"state": "cancelled"}
    assert answer(vlm.cancel(queued)) == {"state": "cancelled"}
    det.die()
    assert refusal(vlm.cancel(held)).code == "lease_lost"


# -- tokens and ownership
def test_only_the_holder_with_the_exact_token_is_heard(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    lease = det.acquire(5 * GIB)
    denied = refusal(vlm.ready(lease))
    assert (denied.code, denied.details["pid"]) == ("not_permitted", det.process.pid)
    assert refusal(det.release(lease, token=Token(1, 99))).code == "stale_token"
    queued = vlm.acquire(5 * GIB)
    assert refusal(vlm.release(queued, token=Token(1, 99))).code == "bad_state"
    assert refusal(vlm.release(LeaseId("L7-7"), token=Token(7, 7))).code == "unknown_lease"
    assert driver.state(lease) == "loading"


def test_a_second_connection_of_the_same_process_speaks_for_it(driver: CoreDriver) -> None:
    det = driver.consumer("det", pid=500)
    lease = det.acquire(5 * GIB)
    other = driver.consumer("det", pid=500)
    other.client = ClientId("c500-2")
    other.connect()
    other.specs = det.specs
    assert answer(other.load(lease))["lease"]["state"] == "held"


# -- ready
def test_ready_charges_the_steady_bytes_or_what_was_measured(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, 4 * GIB)
    effects = det.load(lease)
    assert kinds(effects) == ["Reply", "JournalPut", "Note:ready", "Note:switch", "Sample"]
    assert answer(effects)["lease"]["charge_bytes"] == 4 * GIB
    assert kinds(det.ready(lease)) == ["Reply"], "a repeat changes nothing"
    vlm = driver.consumer("vlm")
    second = vlm.acquire(2 * GIB)
    driver.until(lambda: driver.state(second) == "loading")
    assert answer(vlm.load(second, 1 * GIB))["lease"]["charge_bytes"] == 1 * GIB
    vlm.unloading(second)
    assert refusal(vlm.ready(second)).code == "bad_state"


def test_ready_may_be_repeated_by_a_holder_that_is_revoked(driver: CoreDriver) -> None:
    """The answer to its first `ready` was lost with the connection, and a waiter came. It was
    refused then, and the program saw an error for a load that had succeeded."""
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    lease = det.acquire(5 * GIB)
    det.load(lease)
    vlm.acquire(5 * GIB)
    driver.advance(0.01)
    assert driver.state(lease) == "revoking"
    repeated = det.ready(lease)
    assert kinds(repeated) == ["Reply"]
    assert answer(repeated)["lease"]["state"] == "revoking"


# -- uses
def test_uses_are_idempotent_and_counted_per_process(driver: CoreDriver) -> None:
    det, runner = driver.consumer("det"), driver.consumer("runner")
    lease = det.acquire(5 * GIB)
    assert refusal(det.use_begin(lease)).code == "bad_state"
    det.load(lease)
    token = det.token(lease)
    assert answer(det.use_begin(lease, "u")) == {"uses": 1}
    assert kinds(det.use_begin(lease, "u")) == ["Reply"]
    assert answer(runner.use_begin(lease, "u", token)) == {"uses": 2}, (
        "same name, another process, another use"
    )
    assert answer(runner.use_end(lease, "u", token)) == {"uses": 1}
    assert answer(runner.use_end(lease, "u", token)) == {"uses": 1}, "ended already"
    assert refusal(runner.use_begin(lease, "v", Token(1, 99))).code == "stale_token"
    assert driver.notes("use_ended")[0]["reason"] == "ended"


def test_no_new_use_once_the_holder_was_asked(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    lease = det.acquire(5 * GIB)
    det.load(lease)
    det.use_begin(lease, "old")
    vlm.acquire(5 * GIB)
    assert driver.state(lease) == "revoking"
    assert refusal(det.use_begin(lease, "new")).details == {
        "consumer": "det",
        "state": "revoking",
        "revoked": {"cause": "waiter", "wanted_by": "vlm"},
    }
    assert answer(det.use_begin(lease, "old")) == {"uses": 1}, "a repeat of what runs is fine"


# -- renew
def test_renewing_keeps_alive_and_never_resurrects(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, ttl_s=10.0, min_residency_s=100.0)
    queued = det.acquire(5 * GIB)
    token = det.token(lease)
    driver.advance(9.0)
    renewed = answer(
        det.renew((lease, token), (queued, Token(0, 0)), (LeaseId("L8-8"), Token(8, 8)))
    )
    assert renewed["alive"] == [lease, queued]
    assert [(gone["lease_id"], gone["error"]["code"]) for gone in renewed["gone"]] == [
        ("L8-8", "unknown_lease")
    ]
    driver.advance(9.0)
    assert driver.state(lease) == "held"
    driver.advance(1.1)
    assert driver.state(lease) == "over"
    (gone,) = answer(det.renew((lease, token)))["gone"]
    assert gone["error"]["code"] == "lease_expired"
    assert gone["error"]["details"].keys() == {"lease_id", "ttl_s"}, "for the usual reason"
    assert driver.pushes("lost", lease)[0]["error"]["code"] == "lease_expired"
    assert driver.state(lease) == "over"


# -- leaving
def test_unloading_waits_for_the_safe_point_whoever_marked_the_use(driver: CoreDriver) -> None:
    det, runner = driver.consumer("det"), driver.consumer("runner")
    lease = det.acquire(5 * GIB)
    assert refusal(det.unloading(lease)).code == "bad_state"
    det.load(lease)
    runner.use_begin(lease, "goal", det.token(lease))
    refused = refusal(det.unloading(lease))
    assert (refused.code, refused.details["uses"]) == ("bad_state", 1)
    assert driver.state(lease) == "held"
    runner.use_end(lease, "goal", det.token(lease))
    assert kinds(det.unloading(lease)) == ["Reply", "Note:unloading"]
    assert kinds(det.unloading(lease)) == ["Reply"], "a repeat"
    assert driver.notes("unloading")[0]["asked"] is False


def test_release_may_be_repeated_before_and_after_the_verdict(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB)
    token = det.token(lease)
    assert answer(det.release(lease)) == {"state": "verifying", "next": "released"}
    assert answer(det.release(lease)) == {"state": "verifying", "next": "released"}
    driver.advance(1.0)
    assert answer(det.release(lease, token=token)) == {"state": "released", "next": "released"}
    assert refusal(det.release(lease, token=Token(1, 99))).code == "bad_state"


def test_a_release_in_use_is_a_fact_and_ends_the_uses(driver: CoreDriver) -> None:
    det, runner = driver.consumer("det"), driver.consumer("runner")
    lease = det.acquire(5 * GIB)
    det.load(lease)
    runner.use_begin(lease, "goal", det.token(lease))
    det.hold(0)
    det.release(lease, exiting=True)
    assert driver.notes("use_ended")[0]["why"] == "exits"
    driver.until(lambda: driver.state(lease) == "over")
    assert driver.gpu()["charged_bytes"] == 0


def test_an_acknowledgement_without_a_question_is_only_answered(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB)
    assert kinds(det.ack(lease)) == ["Reply"]


# -- oom
def test_an_out_of_memory_raises_the_learnt_peak_of_its_model(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB)
    effects = det.oom(lease, 1 * GIB)
    assert kinds(effects) == ["Reply", "Note:oom", "Sample"]
    assert answer(effects)["learnt_load_peak_bytes"] == 3 * GIB
    det.release(lease)
    driver.advance(1.0)
    again = det.acquire(2 * GIB)
    view = shown(driver, again)
    assert view["charge_bytes"] == 3 * GIB
    assert (
        answer(det.oom(again, 100 * GIB, 1 * GIB))["learnt_load_peak_bytes"]
        == 8 * GIB - d.RESERVE_BYTES
    )
    assert isinstance(det.oom(again, 1, 1)[0], Reply), "a reading is under way already"


def test_an_out_of_memory_within_the_grant_is_somebody_elses_doing(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(4 * GIB)
    effects = det.oom(lease, 1 * GIB, 2 * GIB)
    assert answer(effects)["learnt_load_peak_bytes"] is None
    assert "another process" in driver.notes("oom")[0]["reason"]
    assert any(isinstance(effect, Sample) for effect in effects)
    assert not any(isinstance(effect, Push) for effect in effects)


# -- memory
def test_what_is_over_is_remembered_for_a_bounded_while(driver: CoreDriver) -> None:
    det, vlm = driver.consumer("det"), driver.consumer("vlm")
    det.acquire(5 * GIB)
    first = vlm.acquire(5 * GIB, nonce="first")
    vlm.cancel(first)
    assert refusal(vlm.release(first, token=Token(1, 1))).code == "cancelled"
    for _ in range(1024):
        vlm.cancel(vlm.acquire(5 * GIB))
    assert refusal(vlm.release(first, token=Token(1, 1))).code == "unknown_lease"
    assert vlm.acquire(5 * GIB, nonce="first") != first
    core = driver.arbiter.inspect()
    assert len(core.ended) == 1024
    assert len(core.nonces) == 1024 + 2
