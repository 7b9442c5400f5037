"""Decisions at their very edge: one byte less, or one moment earlier, and it is decided the other
way."""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import held
from vram_arbiter.arbiter.core.events import MemorySampled, ProcessDied, ProcessUse, Resumed
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

BUDGET = 8 * GIB - d.RESERVE_BYTES


# -- what a process keeps
def kept(driver: CoreDriver, who: Consumer) -> int:
    """What the journal has of the residue of a process, which is what is charged for it."""
    record = driver.journal.get(f"residue:{who.process}:GPU-0", {"residue_bytes": 0})
    account = driver.arbiter.inspect().gpus[driver.device.gpu].ledger.accounts.get(who.process)
    assert (0 if account is None else account.retained_bytes) == record["residue_bytes"]
    return int(record["residue_bytes"])


def leftover(driver: CoreDriver, count: int, residue_bytes: int = 0) -> Consumer:
    """A process that gave its lease back and still holds so much."""
    person, lease = held(driver, "det", 5, residue_bytes=residue_bytes)
    person.unloading(lease)
    person.hold(count)
    person.release(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=15.0)
    assert kept(driver, person) == count
    return person


@pytest.mark.parametrize(("shown", "after"), [(0, 0), (1, 450 * MIB), (100 * MIB, 450 * MIB)])
def test_only_who_is_neither_connected_nor_on_the_gpu_has_no_context(
    driver: CoreDriver, shown: int, after: int
) -> None:
    person = leftover(driver, 450 * MIB, 450 * MIB)
    person.hold(shown)
    driver.advance(3.0)
    assert kept(driver, person) == 450 * MIB, "it is connected: its context may come back any time"
    person.leave()
    driver.consumer("looks on")
    driver.advance(3.0)
    assert kept(driver, person) == after


def test_a_context_that_is_not_on_the_gpu_is_kept_until_all_have_come_back() -> None:
    driver = CoreDriver(8 * GIB)
    person = leftover(driver, 450 * MIB, 450 * MIB)
    other, lease = held(driver, "other", 1)
    token = other.token(lease)
    person.hold(0)
    driver.restart()
    driver.advance(3.0)
    assert kept(driver, person) == 450 * MIB
    other.connect()
    other.reattach(lease, token)
    driver.advance(3.0)
    assert kept(driver, person) == 0


def test_a_reading_that_began_when_a_residue_was_charged_says_nothing_of_it() -> None:
    driver = CoreDriver(8 * GIB)
    person = leftover(driver, 2 * GIB)
    driver.device.silent = True
    charged_at = driver.now
    driver.restart()
    for taken_at, after in ((charged_at, 2 * GIB), (charged_at + 0.0001, 0)):
        driver.post(MemorySampled(driver.device.gpu, taken_at, 0, 8 * GIB, ()))
        assert kept(driver, person) == after


def test_what_a_dead_process_kept_is_measured_away_twice_as_any_bytes(driver: CoreDriver) -> None:
    person = leftover(driver, 450 * MIB, 450 * MIB)
    driver.device.silent = True
    person.die()
    for n, after in ((1, 450 * MIB), (2, 0)):
        driver.post(MemorySampled(driver.device.gpu, driver.now + n / 100, 0, 8 * GIB, ()))
        assert kept(driver, person) == after


def test_one_that_has_a_lease_does_not_keep_others_residues_from_falling() -> None:
    driver = CoreDriver(8 * GIB)
    held(driver, "stays", 1)
    person = leftover(driver, 2 * GIB)
    person.hold(1 * GIB)
    driver.advance(3.0)
    assert kept(driver, person) == 1 * GIB


# -- others that grew
def stranger(driver: CoreDriver, pid: int, count: int) -> None:
    key = ProcessKey(pid, 7 * pid)
    driver.device.names[key] = f"p{9 - pid}"
    driver.device.set(key, count, driver.now)


def culprits(driver: CoreDriver) -> list[tuple[int, str, int]]:
    """Of the last verdict."""
    return [
        (one["pid"], one["name"], one["bytes"]) for one in driver.notes("verified")[-1]["culprits"]
    ]


def test_who_grew_by_a_byte_is_named_and_who_did_not_is_not_the_largest_first() -> None:
    driver = CoreDriver(8 * GIB)
    for pid in range(1, 7):
        stranger(driver, pid, 10 * MIB)
    det, lease = held(driver, "det", 4)
    det.unloading(lease)
    driver.advance(0.5)
    grew = {1: 1, 2: 300 * MIB, 3: 0, 4: 300 * MIB, 5: 500 * MIB, 6: -1}
    for pid, count in grew.items():
        stranger(driver, pid, 10 * MIB + count)
    det.hold(0)
    det.release(lease)
    driver.advance(11.0)
    assert culprits(driver) == [(pid, f"p{9 - pid}", grew[pid]) for pid in (5, 2, 4, 1)]


def test_without_a_reading_from_before_only_strangers_are_named_and_with_all_that_they_hold(
    driver: CoreDriver,
) -> None:
    det, _ = held(driver, "det", 3)
    held(driver, "other", 1)
    driver.device.failing = "the driver hangs"
    driver.restart()
    driver.post(ProcessDied(det.process))
    driver.device.set(det.process, 0, driver.now)
    driver.device.overhead_bytes = 2 * GIB
    stranger(driver, 9, 500 * MIB)
    driver.device.failing = ""
    driver.advance(30.0)
    assert culprits(driver) == [(9, "p0", 500 * MIB)]


def test_a_process_without_a_figure_has_not_grown(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 4)
    det.unloading(lease)
    driver.advance(0.5)
    driver.device.silent = True
    det.release(lease)
    uses = (
        ProcessUse(ProcessKey(8, 8), "silent", None),
        ProcessUse(ProcessKey(9, 9), "browser", GIB),
    )
    for _ in range(25):
        driver.advance(0.5)
        driver.post(MemorySampled(driver.device.gpu, driver.now, GIB, 8 * GIB, uses))
    assert culprits(driver) == [(9, "browser", GIB)]


# -- waiting for a load on another GPU
def two_gpus() -> tuple[CoreDriver, LeaseId, Consumer, LeaseId]:
    """An idle holder on the first GPU; somebody loads on the second, where there is room for one
    more."""
    driver = CoreDriver(8 * GIB, gpus=2)
    _, idle = held(driver, "idle", 6, gpu="0")
    slow = driver.consumer("slow")
    loading = slow.acquire(3 * GIB, gpu="1")
    driver.until(lambda: driver.state(loading) == "loading")
    return driver, idle, slow, loading


def test_small_ones_pass_a_head_that_waits_for_a_load_elsewhere() -> None:
    driver, idle, _, _ = two_gpus()
    driver.consumer("w").acquire(4 * GIB)
    small = driver.consumer("small").acquire(1 * GIB, gpu="0")
    assert (driver.state(idle), driver.state(small)) == ("held", "loading")


@pytest.mark.parametrize(
    "trouble", ["it cannot be read", "pressure", "it has not been read since a suspend"]
)
def test_a_load_on_a_gpu_in_trouble_is_not_waited_for(trouble: str) -> None:
    driver, idle, _, _ = two_gpus()
    device = list(driver.devices.values())[1]
    if trouble == "pressure":
        device.set(ProcessKey(9, 9), 7 * GIB, driver.now)
    elif trouble == "it cannot be read":
        device.failing = "the driver hangs"
    else:
        device.silent = True
        driver.post(Resumed(60.0))
    driver.advance(1.5)
    if trouble == "pressure":
        assert driver.gpu(1)["pressure_bytes"] > 0
        device.set(ProcessKey(9, 9), 0, driver.now)
    driver.consumer("w").acquire(4 * GIB)
    assert driver.state(idle) == "revoking"


@pytest.mark.parametrize(
    ("more", "noted"), [(d.VERIFY_TOLERANCE_BYTES, 1), (d.VERIFY_TOLERANCE_BYTES + 1, 2)]
)
def test_a_stowaway_is_noted_again_if_it_has_grown_by_more_than_the_tolerance(
    driver: CoreDriver, more: int, noted: int
) -> None:
    for count in (GIB, GIB + more, GIB + more):
        stranger(driver, 9, count)
        driver.advance(1.5)
    assert len(driver.notes("stowaway")) == noted


# -- residues in the journal
def restarted_with(driver: CoreDriver, person: Consumer, **changes: Any) -> None:
    """A restart that finds another record of what the process keeps."""
    key = f"residue:{person.process}:GPU-0"
    record = {**driver.journal[key], **changes}
    driver.journal[key] = {name: value for name, value in record.items() if value is not None}
    driver.restart()


@pytest.mark.parametrize(
    ("floor", "after"),
    [(100 * MIB, 100 * MIB), (450 * MIB, 450 * MIB), (900 * MIB, 450 * MIB), (None, 450 * MIB)],
)
def test_a_residue_falls_after_a_restart_to_what_was_declared_of_it(
    driver: CoreDriver, floor: int | None, after: int
) -> None:
    """A record of an older daemon does not say: then all of it was."""
    person = leftover(driver, 450 * MIB, 450 * MIB)
    restarted_with(driver, person, floor_bytes=floor)
    assert kept(driver, person) == 450 * MIB
    person.connect()
    person.hold(0)
    driver.advance(3.0)
    assert kept(driver, person) == after


@pytest.mark.parametrize("room", [450 * MIB, 450 * MIB - 1, 1, 0])
def test_a_residue_of_the_journal_takes_what_room_there_is(driver: CoreDriver, room: int) -> None:
    _, lease = held(driver, "a", 1)
    person = leftover(driver, 450 * MIB, 450 * MIB)
    key = f"lease:{lease}"
    driver.journal[key] = {**driver.journal[key], "charge_bytes": BUDGET - room}
    driver.restart()
    account = driver.arbiter.inspect().gpus[driver.device.gpu].ledger.accounts.get(person.process)
    found = (0, 0) if account is None else (account.retained_bytes, account.retained_floor_bytes)
    assert found == (room, room)
    assert (f"residue:{person.process}:GPU-0" in driver.journal) == bool(room)


def test_what_a_restart_found_is_told_and_what_is_of_a_gpu_that_is_gone_is_taken_out() -> None:
    driver = CoreDriver(8 * GIB)
    person = leftover(driver, 450 * MIB, 450 * MIB)
    _, lease = held(driver, "a", 1)
    _, lost = held(driver, "b", 1)
    gone = {"gpu": "GPU-9"}
    driver.journal[f"lease:{lost}"] = {**driver.journal[f"lease:{lost}"], **gone}
    driver.journal["residue:elsewhere"] = {
        **driver.journal[f"residue:{person.process}:GPU-0"],
        **gone,
    }
    driver.restart()
    recovered = {"kind": "recovered", "leases": [lease], "records": 4}
    assert driver.notes("recovered") == [recovered]
    assert driver.journal.keys() == {f"lease:{lease}", f"residue:{person.process}:GPU-0"}
