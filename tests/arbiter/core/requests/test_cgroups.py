"""Leases that name a cgroup: whose bytes readings are booked on, and that no two processes name
overlapping ones."""

import pytest

from tests.support.core_driver import CoreDriver, refusal
from tests.support.scenes import give_back, held
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import GpuId

UNIT = "/system.slice/llm.service"
GPU_0, GPU_1 = GpuId("GPU-0"), GpuId("GPU-1")


@pytest.mark.parametrize("other", [UNIT, "/system.slice", f"{UNIT}/worker"])
def test_an_overlapping_cgroup_of_another_process_is_refused(
    driver: CoreDriver, other: str
) -> None:
    llm, lease = held(driver, "llm", 2, cgroup=UNIT)
    before = driver.state(lease)
    refused = refusal(driver.consumer("thief").try_acquire(GIB, cgroup=other))
    assert (refused.code, refused.details) == (
        "not_permitted",
        {"cgroup": other, "lease_id": lease, "consumer": "llm", "other": UNIT},
    )
    assert driver.state(lease) == before
    llm.acquire(GIB, cgroup=other)  # its bytes would be booked on the same process


def test_cgroups_beside_each_other_are_two_processes_matter(driver: CoreDriver) -> None:
    named = (UNIT, f"{UNIT}2", "/system.slice/llm")
    for number, cgroup in enumerate(named):
        driver.consumer(f"c{number}").acquire(GIB, cgroup=cgroup)
    assert driver.arbiter.claims(GPU_0).keys() == set(named)


def test_a_cgroup_is_free_again_when_its_lease_is_over(driver: CoreDriver) -> None:
    """Also of a holder that was killed, while its bytes are still measured away."""
    llm, lease = held(driver, "llm", 2, cgroup=UNIT)
    give_back(driver, llm, lease)
    killed, _ = held(driver, "killed", 2, cgroup=UNIT)
    killed.die()
    successor = driver.consumer("next")
    successor.acquire(GIB, cgroup=UNIT)
    assert driver.arbiter.claims(GPU_0) == {UNIT: (successor.process, "next")}


def test_a_cgroup_is_a_waiters_and_a_lease_s_that_is_away_too() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    engine = driver.arbiter
    llm, lease = held(driver, "llm", 6, cgroup=UNIT, gpu="0", standby=True)
    mine = {UNIT: (llm.process, "llm")}
    assert (engine.claims(GPU_0), engine.claims(GPU_1)) == (mine, {})
    driver.consumer("robot").acquire(6 * GIB, priority=90, gpu="0")
    llm.unload(lease)
    driver.until(lambda: driver.state(lease) == "standby")
    assert engine.claims(GPU_0) == mine
    waiter = driver.consumer("waiter")
    waiter.acquire(7 * GIB, cgroup="/w")
    assert engine.claims(GPU_1) == {"/w": (waiter.process, "waiter")}


def test_a_waiter_that_holds_its_bytes_already_is_granted_beside_them(driver: CoreDriver) -> None:
    """A unit that ran before its lease: its bytes are booked on the waiter and not counted twice,
    by ledger and by reading."""
    llm = driver.consumer("llm")
    llm.hold(6 * GIB)
    driver.advance(2.0)
    assert driver.gpu()["stowaway_bytes"] == 6 * GIB
    lease = llm.acquire(6 * GIB, cgroup=UNIT)
    driver.until(lambda: driver.state(lease) == "loading")
    gpu = driver.gpu()
    assert (gpu["charged_bytes"], gpu["stowaway_bytes"], gpu["pressure_bytes"]) == (6 * GIB, 0, 0)


def test_a_restart_keeps_the_cgroup(driver: CoreDriver) -> None:
    llm, lease = held(driver, "llm", 2, cgroup=UNIT)
    token = llm.token(lease)
    driver.restart()
    assert driver.arbiter.claims(GPU_0) == {UNIT: (llm.process, "llm")}
    llm.connect()
    llm.reattach(lease, token)
    driver.until(lambda: driver.state(lease) == "held")
    assert driver.arbiter.claims(GPU_0) == {UNIT: (llm.process, "llm")}
