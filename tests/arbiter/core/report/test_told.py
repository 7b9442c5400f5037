"""What is told, word for word: views, records, notes and refusals are what clients, a restart and
the history stand on."""

from dataclasses import astuple
from typing import Any

import pytest

from tests.support.core_driver import START_S, CoreDriver, answer, as_wire, refusal
from tests.support.scenes import give_back, held, in_use, order, sent_away, shown
from vram_arbiter.arbiter.core.model.lease import Lease
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.codes import Wait, Why


def core_lease(driver: CoreDriver, lease: LeaseId) -> Lease:
    return driver.arbiter.inspect().leases[lease]


def only(found: list[Any]) -> Any:
    (one,) = found
    return one


# -- views
@pytest.mark.parametrize(("exclusive", "mode"), [(True, "exclusive"), (False, "shared")])
def test_a_lease_as_it_is_shown(driver: CoreDriver, exclusive: bool, mode: str) -> None:
    person, lease = held(driver, "det", 2, exclusive=exclusive)
    view = shown(driver, lease)
    assert {
        key: view[key] for key in ("mode", "consumer", "model", "priority", "evictable", "uses")
    } == {
        "mode": mode,
        "consumer": "det",
        "model": "det-model",
        "priority": d.PRIORITY,
        "evictable": True,
        "uses": 0,
    }
    assert (view["charge_bytes"], view["pid"]) == (2 * GIB, person.process.pid)


NO_LEASE = {"lease_ids": [], "charged_bytes": 0, "residue_bytes": 0, "stowaway": True}


def test_a_gpu_as_it_is_shown(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 2)
    driver.device.names[ProcessKey(9, 9)] = "browser"
    driver.device.set(ProcessKey(9, 9), MIB, driver.now)
    driver.device.set(ProcessKey(8, 8), 2 * MIB, driver.now)
    driver.advance(1.5)
    sample = driver.arbiter.inspect().gpus[driver.device.gpu].sample
    assert sample is not None
    shown = driver.gpu()
    assert shown.pop("sample_age_s") == driver.now - sample.taken_at
    process, *stowaways = shown.pop("processes")
    assert shown == {
        "gpu": "GPU-0",
        "index": 0,
        "name": "simulated 0",
        "source": "",
        "capacity_bytes": 8 * GIB,
        "reserve_bytes": d.RESERVE_BYTES,
        "charged_bytes": 2 * GIB,
        "stowaway_bytes": 3 * MIB,
        "measured_used_bytes": 2 * GIB + 3 * MIB,
        "pressure_bytes": 0,
        "blocked": None,
    }
    assert process == {
        "pid": det.process.pid,
        "name": "det",
        "used_bytes": 2 * GIB,
        "lease_ids": [lease],
        "charged_bytes": 2 * GIB,
        "residue_bytes": 0,
        "stowaway": False,
    }
    assert stowaways == [
        {"pid": 8, "name": "p8", "used_bytes": 2 * MIB, **NO_LEASE},
        {"pid": 9, "name": "browser", "used_bytes": MIB, **NO_LEASE},
    ]
    noted = [(note["gpu"], note["pid"], note["name"]) for note in driver.notes("stowaway")]
    assert noted == [("GPU-0", 8, "p8"), ("GPU-0", 9, "browser")]


def test_what_is_in_a_waiters_way_is_told_whole(driver: CoreDriver) -> None:
    """A holder, a lease that is over and not measured gone, and two stowaways."""
    det, _ = held(driver, "det", 2)
    _, lease = held(driver, "holder", 3, evictable=False)
    driver.device.names[ProcessKey(9, 9)] = "browser"
    driver.device.names[ProcessKey(8, 8)] = ""
    driver.device.set(ProcessKey(9, 9), 2 * MIB, driver.now)
    driver.device.set(ProcessKey(8, 8), MIB, driver.now)
    driver.advance(1.5)
    driver.device.lag_s = 60.0
    det.die()
    driver.consumer("w").acquire(5 * GIB)
    told = only(driver.why("w")["leases"])
    blockers = [{k: v for k, v in one.items() if k != "text"} for one in told["blockers"]]
    nothing: dict[str, Any] = {"lease_id": None, "uses": 0}
    assert blockers == [
        {
            "lease_id": lease,
            "consumer": "holder",
            "bytes": 3 * GIB,
            "state": "held",
            "uses": 0,
            "condition": "pinned",
        },
        {
            **nothing,
            "consumer": f"pid {det.process.pid}",
            "bytes": 2 * GIB,
            "state": "debt",
            "condition": "debt",
            "pid": det.process.pid,
        },
        {
            **nothing,
            "consumer": "pid 8",
            "bytes": MIB,
            "state": "stowaway",
            "condition": "stowaway",
            "pid": 8,
        },
        {
            **nothing,
            "consumer": "browser",
            "bytes": 2 * MIB,
            "state": "stowaway",
            "condition": "stowaway",
            "pid": 9,
        },
    ]
    assert told["measuring"] == ["det"]
    assert "expected_bytes" not in told
    assert driver.status()["drained"] == ""


def test_why_of_a_resident_lease_asks_for_nothing(driver: CoreDriver) -> None:
    _, lease = held(driver, "det", 2)
    told = only(driver.why("det")["leases"])
    told.pop("footprint")
    assert told.pop("holder")["condition"] == "idle"
    assert told == {
        "lease_id": lease,
        "consumer": "det",
        "state": "held",
        "position": 0,
        "needed_bytes": 0,
        "free_bytes": 6 * GIB - d.RESERVE_BYTES,
        "deficit_bytes": 0,
        "condition": "resident",
        "blockers": [],
        "next": "it is resident, idle",
        "eta_s": None,
        "eta_source": "none",
        "plan": [],
        "text": "det: it is resident, idle",
    }


# -- answers
def test_an_acquire_said_again_after_the_load_is_answered_as_granted(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(2 * GIB, nonce="n")
    det.load(lease)
    again = answer(det.try_acquire(2 * GIB, nonce="n"))
    assert (again["state"], again["lease"]["state"]) == ("loading", "held")


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


# -- the history
def test_a_load_is_noted_with_what_it_took(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(3 * GIB, 2 * GIB)
    driver.advance(0.5)
    det.hold(1 * GIB)
    det.ready(lease, 1 * GIB)
    note = only(driver.notes("ready"))
    assert (note["charge_bytes"], note["declared_bytes"], note["measured_bytes"]) == (
        1 * GIB,
        2 * GIB,
        1 * GIB,
    )
    assert note["load_ms"] == pytest.approx(500)


def test_a_switch_is_noted_with_what_each_victim_held(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    vlm = driver.consumer("vlm")
    wanted = vlm.acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    vlm.load(wanted)
    (evicted,) = driver.notes("switch")[-1]["evicted"]
    assert evicted == {
        "consumer": "det",
        "lease_id": lease,
        "verdict": "verified",
        "charge_bytes": 5 * GIB,
    }


def test_pressure_and_outages_are_noted_with_their_gpu(driver: CoreDriver) -> None:
    held(driver, "det", 5)
    driver.device.set(ProcessKey(9, 9), 3 * GIB, driver.now)
    driver.advance(2.0)
    assert driver.notes("pressure")[0]["gpu"] == "GPU-0"
    driver.device.failing = "the driver is gone"
    driver.advance(2.0)
    note = only(driver.notes("probe_failed"))
    assert (note["gpu"], note["reason"]) == ("GPU-0", "the driver is gone")


def test_who_is_parked_is_noted_with_its_host_ram() -> None:
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 3 * GIB})
    det, lease = held(driver, "det", 5, park_bytes=2 * GIB)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease, parked=True)
    driver.until(lambda: driver.state(lease) == "parked")
    assert only(driver.notes("parked"))["parked_bytes"] == 2 * GIB


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


def test_a_record_of_who_is_away_says_how_it_comes_back() -> None:
    driver = CoreDriver(8 * GIB, settings={"host_ram_budget_bytes": 3 * GIB})
    _, lease, _, _ = sent_away(driver)
    record = driver.journal[f"lease:{lease}"]
    assert (record["state"], record["comes_back"], "parks" in record) == ("standby", True, False)
    assert (record["left_for"], record["gpu"], record["charge_bytes"]) == ("policy", None, 0)


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


def test_an_adopted_lease_says_where_it_comes_from(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 3)
    token = det.token(lease)
    driver.restart(keep_journal=False)
    det.connect()
    det.reattach(lease, token)
    assert core_lease(driver, lease).story[0][2] == Why.ADOPTED


# -- waiting beside what nobody owns


def test_the_head_says_what_keeps_the_engine_from_asking(driver: CoreDriver) -> None:
    in_use(driver, "det", 5)
    waiting = driver.consumer("vlm").acquire(5 * GIB, priority=d.PRIORITY - 10)
    assert core_lease(driver, waiting).request.reason == Wait.NO_VICTIM


def test_nobody_is_asked_while_a_dead_process_may_still_make_room(driver: CoreDriver) -> None:
    driver.device.lag_s = 0.5
    gone, left = held(driver, "gone", 3, residue_bytes=450 * MIB)
    give_back(driver, gone, left)
    _, lease = held(driver, "det", 5)
    gone.die()
    waiting = driver.consumer("vlm").acquire(3 * GIB)
    assert core_lease(driver, waiting).request.reason == Wait.RESIDUE
    assert driver.state(lease) == "held"


def test_an_answer_to_revoke_is_noted_with_its_lease(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    det.ack(lease, eta_s=0.5)
    note = only(driver.notes("revoke_acked"))
    assert (note["lease_id"], note["safe_point_eta_s"], note["uses"]) == (lease, 0.5, 0)


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
