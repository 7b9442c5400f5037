"""What users of the neighbours complain about: waiting, turns, loads without an end and models
nobody wanted gone. Numbers are those of the list."""

import pytest

from tests.support.core_driver import CoreDriver, answer
from tests.support.scenes import held
from vram_arbiter.schemas.defaults import GIB, MIB


# -- 3: stuck for ever
@pytest.mark.parametrize("asked", [True, False])
def test_3_an_unload_that_hangs_holds_up_nobody_who_can_be_served_without_it(asked: bool) -> None:
    """ollama#7606, #12179, #7779: "Stopping…" for ever, and everything behind it waits too."""
    driver = CoreDriver(8 * GIB)
    stuck, lease = held(driver, "stuck", 4, ttl_s=3600.0)
    _, idle = held(driver, "idle", 3, ttl_s=3600.0)
    if not asked:
        stuck.unloading(lease)  # of its own will
    waiter = driver.consumer("w").acquire(int(4.5 * GIB))
    if asked:
        driver.until(lambda: driver.state(lease) == "revoking")
        stuck.unloading(lease)
    driver.advance(1.0)
    tiny = driver.consumer("small")
    small = tiny.acquire(512 * MIB)
    driver.advance(28.0)
    assert (driver.state(waiter), driver.state(small), driver.state(idle)) == (
        "queued",
        "queued",
        "held",
    )
    assert not driver.notes("deadline_passed"), "a whole deadline is its own"
    driver.advance(2.0)
    (note,) = driver.notes("deadline_passed")
    assert note["consumer"] == "stuck"
    assert driver.state(small) == "loading", "its bytes are not waited for any more"
    told = driver.why("w")["leases"][0]
    assert "'is unloading for 31 s and may hang: end its process (pid" in str(told["blockers"])
    assert "waits for stuck to release, its unloading may hang" in [
        step["text"] for step in told["plan"]
    ]
    assert driver.gpu()["charged_bytes"] >= 7 * GIB, "but they are charged until they are gone"
    tiny.load(small)
    stuck.hold(0)
    stuck.die()
    driver.until(
        lambda: driver.state(waiter) == "loading" or driver.state(idle) == "revoking", limit_s=5.0
    )


# -- 4: thrash and starvation
def test_4_six_that_fit_do_not_wait_for_one_that_idles(driver: CoreDriver) -> None:
    """aprender#3986: one lock for the whole GPU, held for 25 minutes at 97 % idle, six waiters.
    Bytes are leased, not the GPU."""
    _, idle = held(driver, "idle", 1)
    people = [driver.consumer(f"w{n}") for n in range(6)]
    waiters = [person.acquire(1 * GIB) for person in people]
    for person, lease in zip(people, waiters, strict=True):
        driver.until(lambda lease=lease: driver.state(lease) == "loading", limit_s=0.5)
        person.load(lease)
    assert [driver.state(lease) for lease in (idle, *waiters)] == ["held"] * 7


# -- 6: VRAM-aware swap


# -- 7: estimates are wrong


# -- 8: two loads at once
def test_8_memory_that_comes_back_during_a_load_confuses_neither(driver: CoreDriver) -> None:
    """vLLM#56830: asserts if free memory grows while it measures itself. A sibling gives its bytes
    back in the middle of a load."""
    driver.device.lag_s = 0.5
    leaver, going = held(driver, "leaver", 3)
    loader = driver.consumer("loader")
    loading = loader.acquire(4 * GIB)
    loader.hold(1 * GIB)
    leaver.unload(going)
    driver.advance(0.2)
    loader.hold(3 * GIB)
    driver.until(lambda: driver.state(going) == "over", limit_s=2.0)
    (verified,) = driver.notes("verified")
    assert (verified["verdict"], verified["consumer"]) == ("verified", "leaver")
    loader.load(loading)
    driver.advance(0.1)
    assert driver.gpu()["charged_bytes"] == 4 * GIB
    assert driver.gpu()["stowaway_bytes"] == 0


# -- 9: evicts a busy model


# -- 21: manual recipes


@pytest.mark.parametrize("pause_s", [0.0, 0.015])
def test_21_a_detector_that_starts_again_at_once_waits_behind_the_policy(pause_s: float) -> None:
    """OpenRAL ADR-0050: about 15 ms after it was deactivated, autostart activates it again, into
    the memory that was made free."""
    driver = CoreDriver(8 * GIB)
    driver.device.lag_s = 0.2
    detector, lease = held(driver, "detector", 5)
    policy = driver.consumer("policy").acquire(5 * GIB)
    driver.until(lambda: driver.state(lease) == "revoking")
    detector.unload(lease)
    driver.advance(pause_s)
    again = detector.acquire(5 * GIB)
    driver.until(lambda: driver.state(policy) == "loading", limit_s=1.0)
    assert driver.state(again) == "queued"


# -- 22: timeouts are guesses
def test_22_a_load_may_take_as_long_as_it_takes(driver: CoreDriver) -> None:
    """ollama's load timeout, llama-swap's health check: a large model on a slow disk is killed at
    99 %. Whoever is heard of is left alone."""
    vlm = driver.consumer("vlm")
    lease = vlm.acquire(5 * GIB, ttl_s=10.0)
    waiter = driver.consumer("w").acquire(5 * GIB)
    for n in range(100):  # longer than the five minutes of ollama
        vlm.hold(n * 50 * MIB)
        answer(vlm.renew((lease, vlm.token(lease))))
        driver.advance(3.5)
    assert (driver.state(lease), driver.state(waiter)) == ("loading", "queued")
    vlm.load(lease)
    assert [note["consumer"] for note in driver.notes("ready")] == ["vlm"]


def test_22_a_load_without_progress_is_named_with_its_bytes(driver: CoreDriver) -> None:
    """LM Studio#831: people want to know that nothing moves any more, not that 120 s are over."""
    vlm = driver.consumer("vlm")
    lease = vlm.acquire(5 * GIB, ttl_s=3600.0)
    driver.consumer("w").acquire(5 * GIB)
    for gib in (1, 2):
        vlm.hold(gib * GIB)
        driver.advance(20.0)
    moving = driver.why("w")["leases"][0]
    assert "is loading for 40 s, 2.00 GiB so far" in moving["blockers"][0]["text"]
    assert "nothing new for 20 s" in moving["blockers"][0]["text"]
    driver.advance(70.0)
    (stalled,) = driver.why("w")["leases"]
    assert "nothing new for 90 s" in stalled["text"]
    assert "nothing new for 90 s" in driver.why("vlm")["leases"][0]["text"]
    vlm.hold(3 * GIB)
    driver.advance(2.0)
    assert "nothing new for" not in driver.why("w")["leases"][0]["text"]
    assert driver.state(lease) == "loading", "said, and nothing is done to it"
