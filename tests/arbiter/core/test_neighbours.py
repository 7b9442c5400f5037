"""What users of other arbiters and model servers complain about, as tests. Numbers are those of the
list of complaints."""

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import held
from vram_arbiter.schemas import defaults as d

GIB = d.GIB


def test_1_freed_is_not_free_yet(driver: CoreDriver) -> None:
    """llama-swap#97, ollama#9160, comfyui-mcp#2050: the next load starts before the driver returns
    the memory."""
    driver.device.lag_s = 1.5
    det, lease = held(driver, "det", 5)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    det.unload(lease)
    while driver.state(waiter) == "queued":
        assert driver.gpu()["charged_bytes"] == 5 * GIB
        driver.advance(0.01)
    assert sum(driver.device.shown(driver.now).values()) == 0, (
        "nothing of it is left when the next one is told to load"
    )


def test_1_a_failed_poll_prints_nothing_and_frees_nothing(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5)
    waiter = driver.consumer("vlm").acquire(5 * GIB)
    det.unloading(lease)
    driver.device.failing = "timeout"
    det.hold(0)
    det.release(lease)
    driver.advance(60.0)
    assert driver.state(waiter) == "queued"
    assert driver.gpu()["measured_used_bytes"] is None


def test_5_a_big_waiter_does_not_block_small_ones_that_fit(driver: CoreDriver) -> None:
    """ollama#5724, #14578, #7758: head-of-line blocking."""
    busy, lease = held(driver, "busy", 2)
    busy.use_begin(lease)
    big = driver.consumer("big").acquire(6 * GIB)
    small = driver.consumer("small").acquire(1 * GIB)
    driver.advance(0.1)
    assert (driver.state(big), driver.state(small)) == ("queued", "loading")


def test_5_and_small_ones_do_not_starve_the_big_one(driver: CoreDriver) -> None:
    busy, lease = held(driver, "busy", 4)
    busy.use_begin(lease)
    big = driver.consumer("big").acquire(6 * GIB)
    stream = []
    for n in range(20):
        person = driver.consumer(f"small{n}")
        stream.append(person.acquire(1 * GIB))
        driver.advance(0.1)
        if driver.state(stream[-1]) == "loading":
            person.load(stream[-1])
    assert sum(driver.state(lease) == "held" for lease in stream) == 1, "6 + 1 fit, 6 + 2 do not"
    busy.use_end(lease)
    busy.unload(lease)
    driver.until(lambda: driver.state(big) == "loading", limit_s=5.0)


def test_8_two_loads_at_once_mis_measure_each_other(driver: CoreDriver) -> None:
    """vLLM#55827, #56830, ollama#13235: so one GPU loads one model at a time, even if both fit."""
    a, b = driver.consumer("a"), driver.consumer("b")
    first, second = a.acquire(2 * GIB), b.acquire(2 * GIB)
    driver.advance(5.0)
    assert (driver.state(first), driver.state(second)) == ("loading", "queued")
    a.load(first)
    driver.until(lambda: driver.state(second) == "loading", limit_s=0.1)


def test_9_a_busy_model_is_never_evicted(driver: CoreDriver) -> None:
    """llama.cpp#21678, #24849: the request in flight dies with its model."""
    busy, lease = held(driver, "busy", 5)
    busy.use_begin(lease, "request")
    waiter = driver.consumer("w").acquire(5 * GIB, priority=100)
    driver.advance(120.0)
    assert driver.state(lease) == "revoking", "asked, and that is all"
    assert refusal(busy.unloading(lease)).code == "bad_state"
    assert driver.state(waiter) == "queued"
    busy.use_end(lease, "request")
    busy.unload(lease)
    driver.until(lambda: driver.state(waiter) == "loading")


def test_13_two_claims_of_six_on_a_gpu_of_eight(driver: CoreDriver) -> None:
    """taOS#1992: both pass."""
    first = driver.consumer("a").acquire(6 * GIB, evictable=False)
    assert driver.state(first) == "loading"
    second = driver.consumer("b").acquire(6 * GIB, wait_timeout_s=5.0)
    driver.advance(6.0)
    assert driver.pushes("denied", second)[0]["error"]["code"] == "wait_timeout"
    second = driver.consumer("c").acquire(1 * GIB)
    driver.advance(30.0)
    assert driver.state(second) == "queued", "the first still loads"


def test_13_leases_are_not_subtracted_from_a_free_figure_that_includes_them() -> None:
    """taOS#3010, #3026: 3 resident and 4 wanted fit on 8, however often the GPU is read."""
    driver = CoreDriver(8 * GIB)
    held(driver, "a", 3)
    driver.advance(10.0)
    assert driver.state(driver.consumer("b").acquire(4 * GIB)) == "loading"


def test_13_a_renewal_never_resurrects(driver: CoreDriver) -> None:
    det, lease = held(driver, "det", 5, ttl_s=5.0)
    token = det.token(lease)
    driver.advance(5.1)
    (gone,) = answer(det.renew((lease, token)))["gone"]
    assert gone["error"]["code"] == "lease_expired"
    assert driver.state(lease) == "over"
    assert driver.gpu()["charged_bytes"] == 5 * GIB, "and its bytes stay charged: it holds them"


def test_13_a_probe_failure_is_not_free_memory(driver: CoreDriver) -> None:
    driver.device.failing = "NVML_ERROR_UNKNOWN"
    driver.advance(1.1)
    waiter = driver.consumer("a").acquire(1 * GIB)
    driver.advance(10.0)
    assert driver.state(waiter) == "queued"
    assert "cannot be read" in driver.gpu()["blocked"]["text"]
    driver.device.failing = ""
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)
