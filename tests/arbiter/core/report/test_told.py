"""What is told, word for word: records and refusals are what clients and a restart stand on."""

from dataclasses import astuple
from typing import Any

import pytest

from tests.support.core_driver import START_S, CoreDriver, as_wire, refusal
from tests.support.scenes import give_back, held, order, shown
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId
from vram_arbiter.schemas.wire.codes import Wait


def core_lease(driver: CoreDriver, lease: LeaseId) -> Lease:
    return driver.arbiter.inspect().leases[lease]


# -- answers
def test_what_never_fits_says_the_way_out(driver: CoreDriver) -> None:
    refused = refusal(driver.consumer("big").try_acquire(8 * GIB))
    assert (refused.code, refused.hint) == (
        "vram_insufficient",
        "use a smaller model or a lower precision",
    )
    assert refused.message == "big needs 8 GiB; the GPU has 8 GiB less a reserve of 300 MiB"


def test_refusals_of_operators_say_why(driver: CoreDriver) -> None:
    _, lease = held(driver, "det", 5)
    waiting = driver.consumer("vlm").acquire(5 * GIB)
    ops = driver.consumer("ops")

    def told(action: Any, target: LeaseId) -> str:
        return refusal(ops.order(action, target)).message

    assert told("release_dead", waiting) == f"{waiting} is queued: it has no holder"
    other = CoreDriver(8 * GIB)
    _, lease = held(other, "det", 5)
    order(other, "pin", lease)
    ops = other.consumer("ops")
    assert refusal(ops.order("evict", lease)).message == f"{lease} is pinned: an operator pinned it"


# -- the journal
def test_a_record_holds_all_that_was_asked_for() -> None:
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 3 * GIB})
    det = driver.consumer("det")
    wishes: dict[str, Any] = {
        "residue_bytes": 450 * MIB,
        "exclusive": True,
        "priority": 60,
        "evictable": False,
        "gpu": "0",
        "ttl_s": 77.0,
        "min_residency_s": 1.5,
        "standby": True,
        "park_bytes": GIB,
        "key": "grasp",
        "cgroup": "/system.slice/det.service",
    }
    spec = det.spec(3 * GIB, 2 * GIB, **wishes)
    same = sum(
        a == b for a, b in zip(astuple(spec), astuple(det.spec(1 * GIB, GIB // 2)), strict=True)
    )
    assert same == 2, "all differ but the consumer's name and the revision"
    lease = det.acquire(3 * GIB, 2 * GIB, **wishes)
    det.load(lease)
    record = driver.journal[f"lease:{lease}"]
    assert record["spec"] == as_wire(spec)
    rest = {key: value for key, value in record.items() if key != "spec"}
    assert rest == {
        "lease_id": lease,
        "token": [1, 2],
        "state": "held",
        "gpu": "GPU-0",
        "pid": det.process.pid,
        "start_ticks": det.process.start_ticks,
        "nonce": "n1",
        "held_from": START_S + 0.01,
        "charge_bytes": 2 * GIB,
        "load_peak_bytes": 3 * GIB,
        "measured_bytes": None,
        "exiting": False,
    }


def test_a_debt_keeps_the_context_of_a_living_process_over_a_restart(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 3, residue_bytes=450 * MIB, ttl_s=5.0)
    driver.advance(6.0)  # it expired; its process lives
    assert driver.state(lease) == "over"
    driver.restart()
    det.connect()
    det.hold(450 * MIB)
    driver.advance(20.0)
    note = driver.notes("verified")[-1]
    assert (note["lease_id"], note["verdict"], note["residue_bytes"]) == (
        lease,
        "verified",
        450 * MIB,
    )
    assert driver.gpu()["charged_bytes"] == 450 * MIB


# -- waiting beside what nobody owns


def test_nobody_is_asked_while_a_dead_process_may_still_make_room(driver: CoreDriver) -> None:
    driver.device.lag_s = 0.5
    gone, left = held(driver, "gone", 3, residue_bytes=450 * MIB)
    give_back(driver, gone, left)
    _, lease = held(driver, "det", 5)
    gone.die()
    waiting = driver.consumer("vlm").acquire(3 * GIB)
    assert core_lease(driver, waiting).request.reason == Wait.RESIDUE
    assert driver.state(lease) == "held"


def test_the_time_since_the_grant_outlives_a_restart(driver: CoreDriver) -> None:
    """`vramctl status` counted from the restart: a lease that was held for hours looked new."""
    det, lease = held(driver, "det", 2)
    driver.advance(1.0)
    det.renew((lease, det.token(lease)))
    before = shown(driver, lease)["granted_s"]
    assert before == pytest.approx(1.0, abs=0.1)
    driver.restart()
    assert shown(driver, lease)["granted_s"] >= before
    assert shown(driver, lease)["since_s"] < 0.1, "it is in its present state since the restart"
