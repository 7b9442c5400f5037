"""What clients ask for, beside what stories tell."""

from typing import Any

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from vram_arbiter.arbiter.core.effects import Note
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ClientId, Token


def kinds(effects: list[Any]) -> list[str]:
    return [
        f"{type(e).__name__}:{e.kind}" if isinstance(e, Note) else type(e).__name__ for e in effects
    ]


# -- acquire
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


# -- tokens and ownership
def test_a_second_connection_of_the_same_process_speaks_for_it(driver: CoreDriver) -> None:
    det = driver.consumer("det", pid=500)
    lease = det.acquire(5 * GIB)
    other = driver.consumer("det", pid=500)
    other.client = ClientId("c500-2")
    other.connect()
    other.specs = det.specs
    assert answer(other.load(lease))["lease"]["state"] == "held"


# -- ready
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
