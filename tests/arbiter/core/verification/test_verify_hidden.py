"""Holders that live and that the driver's list leaves out: another container's, or all of them for
a moment. Only the total can tell what they gave back, and what nobody showed to be gone is nobody
else's.
"""

from dataclasses import replace

import pytest

from tests.support.core_driver import Consumer, CoreDriver
from tests.support.scenes import give_back, held, hidden_gpu, verdicts
from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.schemas.defaults import GIB, MIB
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

BROWSER = ProcessKey(9, 9)


@pytest.mark.parametrize("since", ["always", "late"])
def test_a_living_holder_that_nobody_lists_is_charged_for_what_it_did_not_give_back(
    driver: CoreDriver, since: str
) -> None:
    """Regression: a process that the list omits counted as one without bytes, and its memory was
    granted again after ten seconds."""
    if since == "always":
        driver.device.unlisted.add(ProcessKey(101, 707))
    det, lease = held(driver, "det", 5, residue_bytes=450 * MIB)
    driver.advance(1.5)
    waiter = driver.consumer("w").acquire(6 * GIB)
    driver.device.unlisted.add(det.process)
    det.unloading(lease)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("residue", True)]
    driver.advance(100.0)
    assert driver.gpu()["charged_bytes"] == 5 * GIB, "its absence from the list never frees it"
    assert driver.state(waiter) == "queued"
    assert (
        f"keeps more than its context until its process (pid {det.process.pid})"
        in driver.why("w")["leases"][0]["text"]
    )
    det.hold(450 * MIB)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=3.0)
    assert driver.gpu()["charged_bytes"] == 6 * GIB + 450 * MIB, (
        "the total showed that it came back"
    )


def test_its_death_frees_what_it_kept(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    waiter = driver.consumer("w").acquire(6 * GIB, exclusive=True)
    driver.device.unlisted.add(det.process)
    det.unloading(lease)
    det.release(lease)
    driver.advance(30.0)
    assert driver.state(waiter) == "queued"
    det.hold(0)
    det.die()
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=0.1)


def test_what_it_gave_back_and_somebody_else_took_is_that_ones(driver: CoreDriver) -> None:
    driver.device.unlisted.add(ProcessKey(101, 707))
    det, lease = held(driver, "det", 5)
    det.unloading(lease)
    det.hold(0)
    driver.device.set(BROWSER, GIB, driver.now)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("contested", True)]
    assert [one["pid"] for one in driver.notes("verified")[0]["culprits"]] == [BROWSER.pid]
    assert (driver.gpu()["charged_bytes"], driver.gpu()["stowaway_bytes"]) == (0, GIB)


def test_less_is_charged_where_a_part_of_it_was_visibly_taken(driver: CoreDriver) -> None:
    driver.device.unlisted.add(ProcessKey(101, 707))
    det, lease = held(driver, "det", 5)
    det.unloading(lease)
    det.hold(2 * GIB)
    driver.device.set(BROWSER, GIB, driver.now)
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("residue", True)]
    assert (driver.gpu()["charged_bytes"], driver.gpu()["stowaway_bytes"]) == (2 * GIB, GIB)


def test_one_that_expired_in_its_load_is_charged_for_what_nobody_explains() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.unlisted.add(ProcessKey(101, 707))
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, ttl_s=10.0)
    driver.until(lambda: driver.state(lease) == "loading")
    det.hold(3 * GIB)
    driver.device.set(BROWSER, GIB, driver.now)
    driver.advance(30.0)
    assert verdicts(driver) == [("residue", True)]
    assert driver.gpu()["charged_bytes"] == 3 * GIB


def test_where_the_list_has_no_bytes_all_of_it_stays_charged(driver: CoreDriver) -> None:
    driver.device.unlisted.add(ProcessKey(101, 707))
    driver.device.knows_bytes = False
    driver.device.set(BROWSER, GIB, driver.now)
    driver.advance(1.5)
    det = driver.consumer("det")
    lease = det.acquire(5 * GIB, ttl_s=10.0)
    driver.until(lambda: driver.state(lease) == "loading")
    det.hold(5 * GIB)
    driver.advance(30.0)
    assert verdicts(driver) == [("residue", True)]
    assert driver.gpu()["charged_bytes"] == 5 * GIB
    driver.advance(30.0)
    assert driver.gpu()["charged_bytes"] == 5 * GIB, (
        "nor does it shrink by readings that cannot say"
    )


def change_places(driver: CoreDriver, det: Consumer, lease: LeaseId) -> None:
    """Another one loads in the moment in which this one leaves, and that is seen at once."""
    vlm = driver.consumer("vlm")
    load = vlm.acquire(3 * GIB)
    driver.until(lambda: driver.state(load) == "loading")
    det.unloading(lease)
    vlm.load(load)
    det.hold(0)
    det.release(lease)
    driver.until(lambda: driver.state(lease) == "over", limit_s=0.1)


def test_two_that_nobody_lists_change_places() -> None:
    """What the one loads while the other leaves is not the other's; what it held before is no
    growth of its."""
    driver = CoreDriver(10 * GIB)
    driver.device.unlisted |= {ProcessKey(pid, 7 * pid) for pid in (101, 102, 103)}
    held(driver, "stays", 2)
    det, lease = held(driver, "det", 4)
    change_places(driver, det, lease)
    assert verdicts(driver) == [("verified", True)]
    assert driver.gpu()["charged_bytes"] == 5 * GIB


def test_one_that_comes_onto_the_list_has_not_grown(driver: CoreDriver) -> None:
    """Its bytes were on the GPU before, so they do not make up for what another one keeps."""
    driver.device.unlisted |= {ProcessKey(101, 707), ProcessKey(102, 714)}
    held(driver, "other", 3)
    det, lease = held(driver, "det", 3)
    driver.advance(1.5)
    det.unloading(lease)
    driver.device.unlisted.discard(ProcessKey(101, 707))
    det.release(lease)
    driver.advance(11.0)
    assert verdicts(driver) == [("residue", True)]
    assert driver.gpu()["charged_bytes"] == 6 * GIB


def test_one_that_comes_onto_the_list_below_its_charge_has_not_grown(driver: CoreDriver) -> None:
    """The ledger has room for what the dead one still holds: only the total from before tells."""
    driver.device.unlisted.add(ProcessKey(101, 707))
    other, _ = held(driver, "other", 4)
    other.hold(2 * GIB)
    det, _ = held(driver, "det", 2)
    driver.advance(1.5)
    driver.device.lag_s = 60.0
    driver.device.unlisted ^= {other.process, det.process}
    det.die()
    driver.advance(11.0)
    assert driver.gpu()["charged_bytes"] == 6 * GIB


def test_one_that_comes_onto_the_list_by_its_load_has_grown(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 3)
    change_places(driver, det, lease)
    assert verdicts(driver) == [("verified", True)]
    assert driver.gpu()["charged_bytes"] == 3 * GIB


def test_what_another_holder_grew_by_right_hides_no_dead_one(driver: CoreDriver) -> None:
    """Regression: growth within a charge counted twice, as allowed and as taken, so a dead holder's
    bytes were granted again."""
    driver.device.lag_s = 15.0
    other, _ = held(driver, "other", 4)
    other.hold(2 * GIB)
    driver.advance(20.0)
    other.hold(2 * GIB)
    det, _ = held(driver, "det", 2)
    driver.device.unlisted.add(det.process)
    det.die()
    other.hold(4 * GIB)
    driver.advance(14.0)
    assert verdicts(driver) == [("contested", False)], (
        "up to its charge it may grow: that was allowed for"
    )
    driver.advance(2.0)
    assert verdicts(driver)[-1] == ("verified", True)


def test_a_process_that_is_known_by_its_pid_alone_is_no_stranger(driver: CoreDriver) -> None:
    det, _ = held(driver, "det", 3)
    ledger = driver.arbiter.inspect().gpus[driver.device.gpu].ledger
    assert (
        ledger.charged_to(ProcessKey(det.process.pid, 0))
        == ledger.charged_to(det.process)
        == 3 * GIB
    )
    assert ledger.charged_to(BROWSER) == 0
    reading = driver.device.read(driver.now)
    assert isinstance(reading, MemorySampled)
    assert ledger.unlisted_bytes(reading) == 0
    assert (
        ledger.unlisted_bytes(replace(reading, processes=(ProcessUse(det.process, "det", None),)))
        is None
    )


# -- what the rule machines found by night
def test_a_lender_that_never_held_anything_keeps_nothing() -> None:
    """Regression (families, seed 20778062350): a GPU that was empty all the time showed a residue
    of 4.3 GB, because so much was charged."""
    driver = hidden_gpu(lists=False)
    lender = driver.consumer("lender")
    lease = lender.acquire(int(4.3e9), exclusive=True)
    driver.until(lambda: driver.state(lease) == "loading")
    lender.ready(lease)
    driver.advance(1.0)
    lender.unload(lease)
    assert driver.until(lambda: driver.state(lease) == "over") < 0.2
    assert driver.gpu()["charged_bytes"] == 0


def restarted_in_a_load() -> tuple[CoreDriver, LeaseId, Consumer, LeaseId]:
    """Return a driver after a restart, without a reading from before it, with a lease that is going
    and has not gone, and a newcomer with its lease, which loads."""
    driver = hidden_gpu(lists=False)
    small, lease = held(driver, "small", 0.5)
    driver.advance(1.0)
    driver.device.lag_s = 2.0
    newcomer = driver.consumer("newcomer")
    wanted = newcomer.acquire(1 * GIB)
    driver.until(lambda: driver.state(wanted) == "loading")
    small.unload(lease)
    driver.restart()
    newcomer.connect()
    newcomer.reattach(wanted, newcomer.token(wanted), held=False)
    return driver, lease, newcomer, wanted


@pytest.mark.parametrize("leaves", [False, True])
def test_a_newcomer_that_is_ready_before_a_reading_ends_hides_no_release(leaves: bool) -> None:
    """Regression (leases, seed 20778062337): what had become ready since the reading began counted
    as on it, in place of what was going."""
    driver, _, newcomer, wanted = restarted_in_a_load()
    driver.advance(0.0)
    newcomer.load(wanted)
    if leaves:
        newcomer.ack(wanted)
    assert driver.until(lambda: driver.gpu()["charged_bytes"] == 1 * GIB) > 1.0


@pytest.mark.parametrize("ends", ["gives back", "fails to load", "dies"])
def test_a_newcomer_that_has_left_before_a_reading_ends_hides_no_release(ends: str) -> None:
    """Regression (leases, seed 80): what was granted and given back while a reading was under way
    counted as on it, in place of what was going, and 5 GB were granted on bytes in use."""
    driver = hidden_gpu(lists=False)
    small, lease = held(driver, "small", 0.5)
    driver.advance(1.0)
    driver.device.lag_s = 2.0
    small.unload(lease)
    driver.advance(0.01)
    driver.device.reading_s = 1.0  # the next readings take long
    driver.advance(0.1)
    newcomer = driver.consumer("newcomer")
    wanted = newcomer.acquire(1 * GIB)
    assert driver.state(wanted) == "loading"
    if ends == "gives back":
        newcomer.load(wanted)
        newcomer.unload(wanted)
    elif ends == "fails to load":
        newcomer.release(wanted)
    else:
        newcomer.die()
    assert driver.until(lambda: driver.state(lease) == "over") > 1.5


def test_a_load_that_its_process_did_not_survive_hides_no_release() -> None:
    """It died while a reading was under way, which may have seen none of what it is charged for:
    after a restart, without a baseline, its debt would cover what is going."""
    driver, lease, newcomer, _ = restarted_in_a_load()
    driver.device.reading_s = 1.0
    driver.advance(0.1)
    newcomer.die()
    assert driver.until(lambda: driver.state(lease) == "over") > 1.5


def test_what_its_own_process_loads_hides_no_release() -> None:
    """Regression: after a restart a load of the same process counted as present already and
    verified a release early (seed 20778062337)."""
    driver = hidden_gpu(lists=False, lag_s=2.0)
    person, lease = held(driver, "person", 0.5)
    driver.advance(1.0)
    wanted = person.acquire(1 * GIB, key="another")
    driver.until(lambda: driver.state(wanted) == "loading")
    person.unload(lease)
    token = person.token(wanted)
    driver.restart()  # no reading from before it
    person.connect()
    person.reattach(wanted, token, held=False)
    driver.advance(1.0)
    assert driver.gpu()["charged_bytes"] == int(1.5 * GIB)
    person.load(wanted)
    driver.until(lambda: driver.gpu()["charged_bytes"] == 1 * GIB)


def test_what_a_process_keeps_is_restored_beside_its_lease() -> None:
    """Regression (rule machine, seed 500085): a GPU that leases fill has room for contexts all the
    same, which lie within their leases."""
    driver = hidden_gpu(lists=False)
    small, first = held(driver, "small", 0.5, residue_bytes=450 * MIB)
    give_back(driver, small, first)
    small.hold(450 * MIB)
    _, second = held(driver, "small", 0.5, small)
    big, lease = held(driver, "big", 7)
    tokens = small.token(second), big.token(lease)
    driver.restart()
    for person, mine, token in zip((small, big), (second, lease), tokens, strict=True):
        person.connect()
        person.reattach(mine, token)
    small.release(second)
    driver.advance(2.0)
    assert driver.gpu()["charged_bytes"] == 7 * GIB + 450 * MIB
