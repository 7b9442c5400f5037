"""Views, `status`, `why` and the record of a switch."""

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, in_use, why
from vram_arbiter.schemas.defaults import (
    GIB,
    MIB,
    RESERVE_BYTES,
    VERIFY_TIMEOUT_S,
)
from vram_arbiter.schemas.ids import ProcessKey


def test_before_the_first_reading_nothing_is_known() -> None:
    driver = CoreDriver(8 * GIB, start=False)
    gpu = driver.gpu()
    assert (gpu["measured_used_bytes"], gpu["sample_age_s"], gpu["processes"]) == (None, None, [])
    assert gpu["blocked"]["text"] == "the GPU has not been read yet"


def test_why_of_a_resident_lease_says_what_it_is_doing(driver: CoreDriver) -> None:
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB)
    says = [why(driver, "det")["text"]]
    det.load(lease)
    det.use_begin(lease)
    says.append(why(driver, "det")["text"])
    det.use_begin(lease, "u2")
    driver.consumer("vlm").acquire(5 * GIB)
    says.append(why(driver, "det")["text"])
    det.use_end(lease)
    det.use_end(lease, "u2")
    det.unloading(lease)
    says.append(why(driver, "det")["text"])
    det.release(lease)
    says.append(why(driver, "det")["text"])
    assert says == [
        "det: it was granted and is loading",
        "det: it is resident, 1 use running",
        "det: it was revoked for vlm, 2 uses running",
        "det: it is unloading",
        "det: it released; its bytes are being measured",
    ]


def test_why_follows_the_way_of_the_holder(driver: CoreDriver) -> None:
    driver.device.lag_s = 0.5
    det, lease = in_use(driver, "det", 5.3, min_residency_s=2.0)
    det.use_begin(lease, "u2")
    driver.consumer("vlm").acquire(int(3.3 * GIB))
    first = why(driver, "vlm")
    assert (first["condition"], first["needed_bytes"]) == ("no_room", int(3.3 * GIB))
    assert first["blockers"] == [
        {
            "lease_id": lease,
            "consumer": "det",
            "bytes": int(5.3 * GIB),
            "state": "held",
            "uses": 2,
            "condition": "residency",
            "seconds": pytest.approx(2.0, abs=0.02),
            "text": "may stay 2.0 s more (minimum residency)",
        }
    ]
    assert first["deficit_bytes"] == int(3.3 * GIB) - (8 * GIB - 300 * MIB - int(5.3 * GIB))
    driver.advance(2.1)
    says = [why(driver, "vlm")["next"]]
    det.use_end(lease)
    says.append(why(driver, "vlm")["next"])
    det.use_end(lease, "u2")
    says.append(why(driver, "vlm")["next"])
    assert why(driver, "vlm")["blockers"][0]["text"].startswith("was revoked 0.1 s ago")
    det.unloading(lease)
    says.append(why(driver, "vlm")["next"])
    assert [b["text"] for b in why(driver, "vlm")["blockers"]] == ["is unloading"]
    det.hold(0)
    det.release(lease)
    says.append(why(driver, "vlm")["next"])
    assert [b["condition"] for b in why(driver, "vlm")["blockers"]] == ["measured"]
    assert says == [
        "waits for det to finish 2 uses (revoked 0.1 s ago), then it unloads and 5.30 GiB are "
        "verified",
        "waits for det to finish 1 use (revoked 0.1 s ago), then it unloads and 5.30 GiB are "
        "verified",
        "waits for det to unload (revoked 0.1 s ago), then 5.30 GiB are verified",
        "det unloads, then 5.30 GiB are verified",
        "5.30 GiB of det are being verified",
    ]


def test_why_keeps_a_late_verdict_on_a_dead_process_apart_from_a_living_one() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 60.0
    det, _ = held(driver, "det", 5)
    det.die()
    driver.consumer("vlm").acquire(5 * GIB)
    driver.advance(VERIFY_TIMEOUT_S + 1.0)
    (blocker,) = why(driver, "vlm")["blockers"]
    assert (blocker["state"], blocker["condition"]) == ("debt", "debt")


def test_why_says_who_is_pinned_idle_or_of_higher_priority() -> None:
    driver = CoreDriver(10 * GIB)
    in_use(driver, "busy", 3, priority=90)
    in_use(driver, "even", 1)
    held(driver, "calm", 1)
    driver.consumer("w").acquire(8 * GIB)
    keeper, keeper_lease = held(driver, "keeper", 1, residue_bytes=450 * MIB, evictable=False)
    conditions = {b["consumer"]: b["text"] for b in why(driver, "w")["blockers"]}
    assert conditions == {
        "busy": "is in use and has priority 90, the waiter 50",
        "even": "is in use for 0 s",
        "calm": "is idle and may be revoked",
        "keeper": "is pinned",
    }
    keeper.unload(keeper_lease)
    driver.advance(1.0)
    blockers = why(driver, "w")["blockers"]
    assert {
        "lease_id": None,
        "consumer": "keeper",
        "bytes": 450 * MIB,
        "state": "residue",
        "uses": 0,
        "condition": "context",
        "pid": keeper.process.pid,
        "text": "keeps its context until it exits",
    } in blockers


def test_why_behind_others_and_behind_a_load(driver: CoreDriver) -> None:
    driver.consumer("det").acquire(5 * GIB)
    driver.consumer("first").acquire(1 * GIB)
    driver.consumer("second").acquire(1 * GIB)
    first, second = driver.notes("queued")
    assert (first["behind"], first["block"]["code"]) == ("", "loading")
    assert (second["behind"], "block" in second) == ("first", False), "the head's is not its own"
    assert why(driver, "first")["next"] == "waits: det is loading"
    assert [b["text"] for b in why(driver, "first")["blockers"]] == ["is loading"]
    assert why(driver, "second")["next"] == "waits behind first as number 2"


def test_why_when_only_measurements_are_missing(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    det.die()
    driver.consumer("w").acquire(5 * GIB)
    assert why(driver, "w")["next"] == "waits until the bytes of det are measured gone"
    driver = CoreDriver(8 * GIB)
    driver.advance(20.0)
    driver.consumer("w").acquire(5 * GIB)
    assert why(driver, "w")["next"] == "waits for a fresh reading of the GPU"
    assert lease


def test_why_names_relief_of_pressure_and_a_victim_of_somebody_else(driver: CoreDriver) -> None:
    calm, lease = held(driver, "calm", 5)
    driver.device.set(ProcessKey(9, 9), 3 * GIB, driver.now)
    driver.until(lambda: driver.state(lease) == "revoking", limit_s=2.0)
    assert why(driver, "calm")["text"] == "calm: it was revoked for relief of pressure, idle"
    assert calm.name == "calm"


def test_a_waiter_of_another_plan_sees_the_room_being_made(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    first = driver.consumer("first")
    first.cancel(first.acquire(5 * GIB))
    driver.consumer("w").acquire(5 * GIB)
    assert why(driver, "w")["condition"] == "making_room"
    assert driver.state(lease) == "revoking"
    assert det.name == "det"


def test_the_label_of_a_use_is_quoted_safely(driver: CoreDriver) -> None:
    """Any process may choose it, and a client prints the answer in its error."""
    det, lease = held(driver, "det", 5)
    det.use_begin(lease, label="look\x1b[2J")
    driver.consumer("vlm").acquire(5 * GIB)
    text = why(driver, "vlm")["text"]
    assert 'finish 1 use "look\\x1b[2J"' in text
    assert "\x1b" not in text


def test_why_of_a_holder_shows_the_room_of_its_own_gpu() -> None:
    """It may be on another GPU than the first that it could have had."""
    driver = CoreDriver(8 * GIB, gpus=2)
    held(driver, "det", 7)
    held(driver, "vlm", 3)
    assert why(driver, "vlm")["free_bytes"] == 5 * GIB - RESERVE_BYTES
