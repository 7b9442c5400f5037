"""The ladder: ask, ask again until heard, remind, deadline. Exact times, no sleep."""

from tests.support.core_driver import CoreDriver
from tests.support.scenes import held, in_use
from vram_arbiter.arbiter.core.events import ClientConnected
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ClientId


def test_a_waiter_that_is_patient_waits_past_the_deadline(driver: CoreDriver) -> None:
    det, lease = in_use(driver, "det", 5)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    driver.advance(31.0)
    assert len(driver.notes("deadline_passed")) == 1
    assert driver.state(waiter) == "queued"
    driver.advance(60.0)
    assert len(driver.notes("deadline_passed")) == 1
    det.use_end(lease)
    det.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")


def test_a_holder_that_does_not_answer_at_the_deadline_no_longer_counts_as_leaving() -> None:
    """Another idle holder is asked instead, so that the waiter does not hang on a deaf one."""
    driver = CoreDriver(8 * GIB)
    deaf, deaf_lease = held(driver, "deaf", 5)
    idle = driver.consumer("idle")
    idle_lease = idle.acquire(2 * GIB)
    driver.until(lambda: driver.state(idle_lease) == "loading")
    idle.load(idle_lease)
    waiter = driver.consumer("w").acquire(2 * GIB, residue_bytes=0)
    assert (driver.state(deaf_lease), driver.state(idle_lease)) == ("held", "revoking")
    driver.advance(31.0)
    assert driver.state(deaf_lease) == "revoking"
    deaf.unload(deaf_lease)
    driver.until(lambda: driver.state(waiter) == "loading")


def test_a_voluntary_release_while_asked_is_as_good(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    assert driver.state(lease) == "revoking"
    asked_at = driver.arbiter.inspect().gpus[driver.device.gpu].asked_at
    assert asked_at == driver.now, "a reading of before is under way"
    det.hold(0)
    det.release(lease)
    driver.until(lambda: driver.state(waiter) == "loading")
    assert driver.state(lease) == "over"


def test_a_reminder_between_two_pushes_pushes_nothing() -> None:
    driver = CoreDriver(8 * GIB, settings={"revoke_resend_s": 0.3})
    in_use(driver, "det", 5)
    driver.consumer("vlm").acquire(5 * GIB)
    driver.advance(2.05)
    assert len(driver.pushes("revoke")) == 7
    assert len(driver.notes("reminded")) == 1


def test_a_holder_that_comes_back_is_asked_again_and_keeps_the_uses_of_others() -> None:
    driver = CoreDriver(8 * GIB)
    det, lease = held(driver, "det", 5)
    runner = driver.consumer("runner")
    runner.use_begin(lease, "goal", det.token(lease))
    det.use_begin(lease, "own")
    driver.consumer("vlm").acquire(5 * GIB)
    det.ack(lease)
    driver.advance(1.0)
    assert len(driver.pushes("revoke")) == 1
    old, det.client = det.client, ClientId("c-new")
    driver.post(
        ClientConnected(det.client, det.process, 1000, "det", f"det-{old}")
    )  # the same instance
    det.reattach(lease, det.token(lease))
    assert driver.pushes("revoke")[-1]["uses"] == 1
    driver.advance(0.3)
    assert len(driver.pushes("revoke")) == 3, "until this connection acknowledges"
