"""Several GPUs: a lease is placed on one of them and never split, every GPU has its own queue,
and no GPU waits for another's sake."""

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.scenes import give_back, held, in_use, place, verdicts
from vram_arbiter.arbiter.core.events import ProcessDied
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import GpuId, LeaseId

ZERO, ONE = GpuId("GPU-0"), GpuId("GPU-1")
GPUS = 2


# -- selector and placement
@pytest.mark.parametrize(
    ("selector", "wanted"), [("1", ONE), ("GPU-1", ONE), ("0", ZERO), ("any", ZERO)]
)
def test_a_selector_is_an_uuid_an_index_or_any(selector: str, wanted: GpuId) -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    _, lease = held(driver, "a", 5, gpu=selector)
    assert place(driver, lease) == wanted
    assert [driver.gpu(n)["charged_bytes"] for n in (0, 1)] == [
        5 * GIB if wanted is gpu else 0 for gpu in (ZERO, ONE)
    ]


def test_a_lease_is_never_split(driver: CoreDriver) -> None:
    """12 GiB are free on two GPUs, 7 on each is all that one lease can ever have."""
    assert refusal(driver.consumer("a").try_acquire(9 * GIB)).code == "vram_insufficient"
    _, lease = held(driver, "b", 7)
    assert sum(1 for n in (0, 1) if driver.gpu(n)["charged_bytes"]) == 1
    _, other = held(driver, "c", 7)
    assert {place(driver, lease), place(driver, other)} == {ZERO, ONE}


def test_a_model_over_two_gpus_is_two_leases_of_one_process(driver: CoreDriver) -> None:
    big = driver.consumer("big")
    halves = [
        big.acquire(6 * GIB, gpu=str(n), key=f"half {n}", residue_bytes=GIB // 2) for n in (0, 1)
    ]
    assert [driver.state(half) for half in halves] == ["loading", "loading"], (
        "one load a GPU, not one in all"
    )
    for half in halves:
        big.load(half)
    driver.advance(0.01)
    big.unload(halves[0])
    driver.until(lambda: driver.state(halves[0]) == "over")
    assert [driver.gpu(n)["charged_bytes"] for n in (0, 1)] == [GIB // 2, 6 * GIB], (
        "a context a GPU"
    )
    big.die()
    driver.until(
        lambda: driver.gpu(0)["charged_bytes"] + driver.gpu(1)["charged_bytes"] == 0, limit_s=2.0
    )


def test_pins_are_in_the_way_on_their_own_gpu_only(driver: CoreDriver) -> None:
    held(driver, "pinned", 5, gpu="0", evictable=False)
    waiter = driver.consumer("a").acquire(5 * GIB, gpu="0")
    _, lease = held(driver, "b", 5)
    assert (place(driver, lease), driver.state(waiter)) == (ONE, "queued")


def test_exclusive_means_alone_on_its_gpu(driver: CoreDriver) -> None:
    _, alone = held(driver, "alone", 2, exclusive=True, evictable=False)
    _, other = held(driver, "other", 2)
    assert (place(driver, alone), place(driver, other)) == (ZERO, ONE)


# -- queues
def test_a_waiter_for_one_gpu_does_not_hold_up_another(driver: CoreDriver) -> None:
    in_use(driver, "busy", 6, gpu="0")
    waits = driver.consumer("w").acquire(6 * GIB, gpu="0", priority=90)
    _, free = held(driver, "free", 6, gpu="1")
    assert (driver.state(waits), place(driver, free)) == ("queued", ONE)


def test_whoever_waits_for_any_takes_the_first_gpu_that_is_free_and_leaves_both_queues() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    people = [held(driver, f"busy{n}", 6, gpu=str(n)) for n in (0, 1)]
    for person, lease in people:
        person.use_begin(lease)
    waiter = driver.consumer("w").acquire(6 * GIB, priority=0)
    driver.advance(1.0)
    assert driver.state(waiter) == "queued"
    people[1][0].use_end(people[1][1])
    people[1][0].unload(people[1][1])
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)
    assert place(driver, waiter) == ONE
    assert driver.state(people[0][1]) == "held", "nobody is asked in vain on the other GPU"
    assert all(gpu.queue.head is None for gpu in driver.arbiter.inspect().gpus.values())


def test_while_one_gpu_is_emptied_for_the_head_the_next_one_is_served_on_the_other() -> None:
    """Regression: the head of both queues held up the other GPU while its victim finished a long
    use."""
    driver = CoreDriver(8 * GIB, gpus=2)
    busy, used = held(driver, "busy", 6, gpu="0", priority=10)
    idle, unused = held(driver, "idle", 6, gpu="1", evictable=False)
    busy.use_begin(used)
    head = driver.consumer("head").acquire(6 * GIB, gpu="0")
    assert driver.state(used) == "revoking"
    anywhere = driver.consumer("anywhere").acquire(int(1.5 * GIB), gpu="1")
    driver.until(lambda: driver.state(anywhere) == "loading", limit_s=1.0)
    assert (place(driver, anywhere), driver.state(head)) == (ONE, "queued")
    assert driver.state(unused) == "held"
    assert idle.driver is driver


def test_the_head_that_is_placed_elsewhere_does_not_keep_a_gpu_from_the_next() -> None:
    """Regression: with `any` at the head, a waiter for GPU 1 waited until GPU 0 had been
    emptied."""
    driver = CoreDriver(8 * GIB, gpus=2)
    first, a = held(driver, "a", 6, gpu="0", priority=10)
    second, b = held(driver, "b", 6, gpu="1", priority=20)
    first.use_begin(a)
    second.use_begin(b)
    head = driver.consumer("head").acquire(6 * GIB)
    assert (driver.state(a), driver.state(b)) == ("revoking", "held"), "the cheaper GPU"
    other = driver.consumer("other").acquire(6 * GIB, gpu="1")
    driver.until(lambda: driver.state(b) == "revoking", limit_s=0.1)
    second.use_end(b)
    second.unload(b)
    driver.until(lambda: "loading" in (driver.state(other), driver.state(head)), limit_s=1.0)
    placed = head if driver.state(head) == "loading" else other
    assert place(driver, placed) == ONE, "whoever it is, the free GPU is used at once"


def test_what_fits_beside_the_head_that_is_placed_elsewhere_is_granted(driver: CoreDriver) -> None:
    """It is the head here: no backfill has to let it pass, and nothing is spared for a waiter that
    comes to another GPU."""
    first, a = held(driver, "a", 6, gpu="0", priority=10)
    second, b = held(driver, "b", 4, gpu="1", priority=90)
    first.use_begin(a)
    second.use_begin(b)
    head = driver.consumer("head").acquire(6 * GIB)
    assert driver.state(a) == "revoking"
    other = driver.consumer("other").acquire(int(3.5 * GIB), gpu="1")
    driver.until(lambda: driver.state(other) == "loading", limit_s=1.0)
    assert (place(driver, other), driver.state(head)) == (ONE, "queued")


def test_the_head_that_gets_a_place_elsewhere_lets_those_behind_it_proceed_at_once() -> None:
    driver = CoreDriver(8 * GIB, gpus=2)
    first, a = in_use(driver, "a", 6, gpu="0", priority=90)
    in_use(driver, "b", 4, gpu="1", priority=90)
    head = driver.consumer("head").acquire(6 * GIB)
    other = driver.consumer("other").acquire(int(3.5 * GIB), gpu="1")
    driver.advance(0.5)
    assert driver.state(other) == "queued", "the head may come to either GPU"
    first.use_end(a)
    assert driver.state(a) == "revoking"
    driver.advance(0.01)
    assert (driver.state(other), driver.state(head)) == ("loading", "queued")


def test_two_heads_that_are_placed_elsewhere_leave_the_gpu_to_nobody(driver: CoreDriver) -> None:
    first, a = held(driver, "a", 3, gpu="0", priority=10)
    second, b = held(driver, "b", 3, gpu="0", priority=10)
    third, c = held(driver, "c", 6, gpu="1", priority=90)
    for person, lease in ((first, a), (second, b), (third, c)):
        person.use_begin(lease)
    waiting = [driver.consumer(f"w{n}").acquire(4 * GIB) for n in range(2)]
    driver.advance(1.0)
    assert driver.state(c) == "held"
    assert [driver.state(lease) for lease in waiting] == ["queued", "queued"]
    for person, lease in ((first, a), (second, b)):
        person.use_end(lease)
        if driver.state(lease) == "revoking":
            person.unload(lease)
    driver.until(lambda: driver.state(waiting[0]) == "loading", limit_s=2.0)


def test_a_holder_that_outstays_on_one_gpu_frees_its_waiter_for_another(driver: CoreDriver) -> None:
    """Regression: once somebody was asked on GPU 0, no other GPU was ever considered."""
    stuck, a = held(driver, "stuck", 6, gpu="0", priority=10)
    later, b = held(driver, "later", 6, gpu="1", priority=20, min_residency_s=5.0)
    stuck.use_begin(a)
    later.use_begin(b)
    waiter = driver.consumer("w").acquire(6 * GIB)
    assert driver.state(a) == "revoking"
    later.use_end(b)
    driver.advance(20.0)
    assert driver.state(b) == "held", "one GPU is being emptied: nothing is evicted in vain"
    driver.until(lambda: driver.state(b) == "revoking", limit_s=15.0)
    later.unload(b)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=1.0)
    assert place(driver, waiter) == ONE


def test_a_leave_that_was_not_enough_frees_its_waiter_for_another_gpu(driver: CoreDriver) -> None:
    """The bytes of the victim stay on GPU 0 as a residue that nobody expected: GPU 1 is emptied
    at once."""
    leaky, a = held(driver, "leaky", 6, gpu="0", priority=10)
    _, b = held(driver, "b", 6, gpu="1", priority=20)
    waiter = driver.consumer("w").acquire(6 * GIB)
    assert (driver.state(a), driver.state(b)) == ("revoking", "held")
    leaky.unloading(a)
    leaky.release(a)
    driver.until(lambda: verdicts(driver) == [("residue", True)], limit_s=15.0)
    assert (driver.state(b), driver.state(waiter)) == ("revoking", "queued")


# -- at once, and without asking
def test_what_fits_on_the_other_gpu_goes_there_and_nobody_is_asked(driver: CoreDriver) -> None:
    """The first GPU could be emptied, its holder is idle; the second is free."""
    _, idle = held(driver, "idle", 6, gpu="0", priority=1)
    lease = driver.consumer("w").acquire(6 * GIB)
    assert (driver.state(lease), place(driver, lease)) == ("loading", ONE)
    assert driver.state(idle) == "held"
    assert not driver.notes("revoke_asked")


def test_while_somebody_loads_where_it_fits_nobody_is_asked_elsewhere(driver: CoreDriver) -> None:
    """Regression: the idle holder of the first GPU was thrown out for the seconds that a load on
    the second took."""
    _, idle = held(driver, "idle", 6, gpu="0")
    loads = driver.consumer("loads")
    loading = loads.acquire(1 * GIB, gpu="1")
    lease = driver.consumer("w").acquire(6 * GIB)
    driver.advance(5.0)
    assert (driver.state(idle), driver.state(lease)) == ("held", "queued")
    loads.load(loading)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=1.0)
    assert place(driver, lease) == ONE
    assert not driver.notes("revoke_asked")


# -- order and ageing
def test_whoever_came_first_is_first_on_every_gpu(driver: CoreDriver) -> None:
    people = [held(driver, f"busy{n}", 6, gpu=str(n), priority=90) for n in (0, 1)]
    for person, lease in people:
        person.use_begin(lease)
    first = driver.consumer("first").acquire(6 * GIB)
    second = driver.consumer("second").acquire(6 * GIB)
    higher = driver.consumer("higher").acquire(6 * GIB, priority=60, gpu="1")
    driver.advance(0.1)
    assert [driver.view(lease)["position"] for lease in (first, second, higher)] == [1, 2, 1]
    for person, lease in people:
        person.use_end(lease)
        person.unload(lease)
    driver.until(lambda: "loading" in {driver.state(first), driver.state(second)}, limit_s=1.0)
    driver.until(lambda: driver.state(higher) == "loading", limit_s=1.0)
    assert (place(driver, first), place(driver, higher), driver.state(second)) == (
        ZERO,
        ONE,
        "queued",
    )


def test_a_waiter_for_any_gpu_ages_on_all_of_them(driver: CoreDriver) -> None:
    """Both holders are in use and above it; it is let to ask the lower one first, when it has aged
    to that."""
    leases = []
    for index, priority in ((0, 56), (1, 54)):
        _, lease = in_use(driver, f"busy{index}", 6, gpu=str(index), priority=priority)
        leases.append(lease)
    waiter = driver.consumer("w").acquire(6 * GIB, priority=50)
    step_s = driver.settings.ageing_s_per_point
    driver.advance(4 * step_s - 0.1)
    assert [driver.state(lease) for lease in leases] == ["held", "held"]
    driver.advance(0.2)
    assert [driver.state(lease) for lease in leases] == ["held", "revoking"]
    driver.advance(3 * step_s)
    assert [driver.state(lease) for lease in leases] == ["held", "revoking"], "one GPU is enough"
    assert driver.state(waiter) == "queued"


# -- standby
def on_standby(driver: CoreDriver, selector: str) -> tuple[Consumer, LeaseId]:
    """A detector that left GPU 0 for a policy which is there now; GPU 1 is in use, and by nobody
    who may be asked."""
    filler, fills = held(driver, "filler", 6, gpu="1", evictable=False)
    det, lease = held(driver, "det", 5, gpu=selector, standby=True)
    assert place(driver, lease) == ZERO
    policy = driver.consumer("policy")
    wanted = policy.acquire(5 * GIB, gpu="0")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    policy.load(wanted)
    policy.use_begin(wanted)
    driver.advance(1.0)
    assert driver.state(lease) == "standby"
    give_back(driver, filler, fills)
    return det, lease


@pytest.mark.parametrize(("selector", "wanted"), [("any", ONE), ("0", None), ("GPU-0", None)])
def test_standby_returns_to_the_gpus_that_its_selector_names(
    driver: CoreDriver, selector: str, wanted: GpuId | None
) -> None:
    det, lease = on_standby(driver, selector)
    driver.advance(10.0)
    assert place(driver, lease) == wanted
    policy = next(iter(driver.arbiter.inspect().gpus[ZERO].residents.values()))
    if wanted is None:
        driver.post(ProcessDied(policy.process))
        for one in driver.devices.values():
            one.set(policy.process, 0, driver.now)
        driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
        assert place(driver, lease) == ZERO
    det.load(lease)
    assert driver.state(lease) == "held"


def test_a_waiter_for_one_gpu_keeps_nobody_from_returning_to_another(driver: CoreDriver) -> None:
    _, lease = on_standby(driver, "any")
    waiter = driver.consumer("w").acquire(5 * GIB, gpu="0", priority=10)
    driver.until(lambda: driver.state(lease) == "loading", limit_s=2.0)
    assert (place(driver, lease), driver.state(waiter)) == (ONE, "queued")


# -- GPUs that fail, drains
def test_a_gpu_that_is_lost_keeps_its_leases_and_the_others_go_on(driver: CoreDriver) -> None:
    """Unplugged in the middle: what was held there stays charged there, and whoever may go
    elsewhere does."""
    _, b = held(driver, "b", 5, gpu="1")
    a, freed = held(driver, "a", 5, gpu="0")
    driver.devices[ONE].failing = "NVML_ERROR_GPU_IS_LOST"
    driver.advance(1.5)
    waiter = driver.consumer("w").acquire(5 * GIB)
    assert (driver.state(freed), driver.state(b)) == ("revoking", "held"), (
        "it is made room on the GPU that lives"
    )
    a.unload(freed)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=1.0)
    assert place(driver, waiter) == ZERO
    assert driver.gpu(1)["charged_bytes"] == 5 * GIB


def test_pressure_on_one_gpu_asks_nobody_on_another(driver: CoreDriver) -> None:
    _, a = held(driver, "a", 6, gpu="0")
    _, b = held(driver, "b", 6, gpu="1")
    driver.devices[ZERO].set(driver.consumer("game").process, 4 * GIB, driver.now)
    driver.until(lambda: driver.state(a) == "revoking", limit_s=5.0)
    assert driver.state(b) == "held"


def test_verifications_are_per_gpu(driver: CoreDriver) -> None:
    """The bytes that one GPU gets back do not prove that another did."""
    big = driver.consumer("big")
    halves = [big.acquire(6 * GIB, gpu=str(n), key=f"half {n}") for n in (0, 1)]
    for half in halves:
        big.load(half)
    driver.advance(0.01)
    driver.devices[ONE].lag_s = 3.0
    for half in halves:
        big.unload(half)
    driver.until(lambda: driver.state(halves[0]) == "over", limit_s=1.0)
    assert driver.state(halves[1]) == "verifying"
    assert driver.gpu(1)["charged_bytes"] == 6 * GIB
    driver.until(lambda: driver.state(halves[1]) == "over", limit_s=4.0)


# -- restarts
def test_a_restart_keeps_every_lease_on_its_gpu(driver: CoreDriver) -> None:
    people = [held(driver, f"p{n}", 5, gpu=str(n)) for n in (0, 1)]
    tokens = [person.token(lease) for person, lease in people]
    driver.restart()
    assert [driver.gpu(n)["charged_bytes"] for n in (0, 1)] == [5 * GIB, 5 * GIB]
    for (person, lease), token in zip(people, tokens, strict=True):
        person.connect()
        answer(person.reattach(lease, token))
    assert [place(driver, lease) for _, lease in people] == [ZERO, ONE]


@pytest.mark.parametrize("lists", [True, False])
def test_without_a_journal_a_lease_is_found_on_the_gpu_that_shows_its_process(lists: bool) -> None:
    """Regression: with `any` it was charged to the first GPU, and its own was granted again."""
    driver = CoreDriver(8 * GIB, gpus=2)
    held(driver, "first", 5, gpu="0")
    person, lease = held(driver, "second", 5)
    assert place(driver, lease) == ONE
    token = person.token(lease)
    for one in driver.devices.values():
        one.lists_processes = lists
    driver.restart(keep_journal=False)
    person.connect()
    (kept,) = answer(person.reattach(lease, token))["leases"]
    assert kept["kept"] is True
    assert place(driver, lease) == (ONE if lists else ZERO), "without a list nobody can say"


# -- at random
