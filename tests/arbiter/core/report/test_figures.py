"""The present in numbers, and the traces that facts and pushes name."""

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, sent_away
from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.arbiter.core.report.status import RESIDUES, STOWAWAYS, UNATTRIBUTED
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import ProcessKey

GIB, MIB = d.GIB, d.MIB
HERS = f"00-{'a' * 32}-{'1' * 16}-01"
HIS = f"00-{'b' * 32}-{'2' * 16}-01"


# -- figures
def test_what_is_charged_and_measured_by_consumer() -> None:
    driver = CoreDriver(8 * GIB)
    person, _ = held(driver, "det", 2)
    held(driver, "det", 1)
    held(driver, "vlm", 3)
    driver.consumer("policy").acquire(4 * GIB)
    stowaway = ProcessKey(99, 1)
    driver.device.set(stowaway, 64 * MIB, driver.now)
    driver.device.set(person.process, 2 * GIB + MIB, driver.now)
    driver.advance(1.1)
    figures = driver.arbiter.figures()
    assert figures.waiters == 1
    (gpu,) = figures.gpus
    assert (gpu.gpu, gpu.capacity_bytes) == ("GPU-0", 8 * GIB)
    assert gpu.charged == {"det": 3 * GIB, "vlm": 3 * GIB}
    assert gpu.used_bytes == 6 * GIB + 65 * MIB
    assert gpu.measured == {
        "det": 3 * GIB + MIB,
        "vlm": 3 * GIB,
        STOWAWAYS: 64 * MIB,
    }


def test_residues_have_no_consumer_and_shared_processes_both() -> None:
    driver = CoreDriver(8 * GIB)
    person, lease = held(driver, "det", 2, residue_bytes=512 * MIB)
    both, _ = held(driver, "vlm", 1)
    both.name = "helper"
    held(driver, "helper", 1, person=both)
    driver.device.set(both.process, 2 * GIB, driver.now)
    person.unload(lease)
    driver.device.set(person.process, 512 * MIB, driver.now)
    driver.until(lambda: driver.state(lease) == "over")
    driver.advance(1.1)
    (gpu,) = driver.arbiter.figures().gpus
    assert gpu.charged == {"vlm": GIB, "helper": GIB, RESIDUES: 512 * MIB}
    assert gpu.used_bytes == 2 * GIB + 512 * MIB
    assert gpu.measured == {"helper+vlm": 2 * GIB, RESIDUES: 512 * MIB}


def test_a_gpu_that_cannot_be_read_shows_no_bytes() -> None:
    driver = CoreDriver(8 * GIB, start=False)
    assert driver.arbiter.figures().gpus[0].measured is None, "not read yet"
    driver.advance(0.01)
    driver.device.lists_processes = False
    held(driver, "det", 2)
    assert driver.arbiter.figures().gpus[0].measured == {UNATTRIBUTED: 2 * GIB}
    driver.device.lists_processes, driver.device.knows_bytes = True, False
    driver.advance(1.1)
    assert driver.arbiter.figures().gpus[0].measured == {UNATTRIBUTED: 2 * GIB}, (
        "listed, without their bytes"
    )
    driver.device.failing = "lost"
    driver.advance(1.1)
    (gpu,) = driver.arbiter.figures().gpus
    assert (gpu.measured, gpu.used_bytes) == (None, None)
    assert gpu.charged == {"det": 2 * GIB}


def test_pressure_a_drain_and_the_time_of_the_reading() -> None:
    """An alert could not tell a drained daemon or one under pressure from an idle one."""
    driver = CoreDriver(8 * GIB)
    figures = driver.arbiter.figures()
    assert (figures.drained, figures.gpus[0].pressure_bytes) == (False, 0)
    person, _ = held(driver, "det", 2)
    event = OperatorAsked(
        person.client, driver.next_request(), "drain", "", "operator", "maintenance"
    )
    driver.post(event)
    driver.device.set(person.process, 8 * GIB, driver.now)
    driver.advance(1.1)
    figures = driver.arbiter.figures()
    (gpu,) = figures.gpus
    assert figures.drained
    assert gpu.pressure_bytes == driver.gpu()["pressure_bytes"] > 0
    assert gpu.read_at is not None
    assert driver.now - 1.1 <= gpu.read_at <= driver.now


# -- traces
def test_a_holder_is_asked_in_the_name_of_whoever_waits() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5)
    assert "traceparent" not in driver.notes("granted")[-1]
    vlm = driver.consumer("vlm")
    vlm.traceparent = HERS
    vlm.acquire(5 * GIB)
    driver.advance(1.0)
    assert {push["traceparent"] for push in driver.pushes("revoke")} == {HERS}
    assert det.traceparent is None
    assert driver.state(lease) == "revoking"


def test_a_waiter_without_a_trace_names_none() -> None:
    driver = CoreDriver(8 * GIB)
    held(driver, "det", 5)
    driver.consumer("vlm").acquire(5 * GIB)
    assert "traceparent" not in driver.pushes("revoke")[0]


def test_a_lease_that_is_called_back_belongs_to_the_caller() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease, policy, wanted = sent_away(driver)
    det.traceparent = HERS
    det.reacquire(lease)
    assert driver.notes("queued")[-1]["traceparent"] == HERS
    assert driver.pushes("revoke", wanted)[0]["traceparent"] == HERS
    det.cancel(lease)
    assert policy.traceparent is None


def test_one_that_is_called_back_while_it_is_measured_too() -> None:
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 1.0
    det, lease = held(driver, "det", 5, standby=True)
    det.traceparent = HIS
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, wait_timeout_s=60.0)
    det.unload(lease)
    assert driver.state(lease) == "verifying"
    det.reacquire(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    driver.until(lambda: bool(driver.pushes("revoke", wanted)))
    assert driver.pushes("revoke", wanted)[0]["traceparent"] == HIS


def test_a_grant_says_whether_it_was_asked_for() -> None:
    driver = CoreDriver(8 * GIB)
    _, lease, policy, wanted = sent_away(driver)
    assert not any("by_itself" in note for note in driver.notes("granted"))
    policy.unload(wanted)
    driver.until(lambda: driver.state(lease) == "loading")
    assert driver.notes("granted")[-1]["by_itself"] is True
