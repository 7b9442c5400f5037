"""On which GPUs a lease may be, and what that becomes when pins end, daemons restart and
GPUs go."""

from dataclasses import replace
from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer
from tests.support.scenes import held, place
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import GpuId, LeaseId

ZERO, ONE = GpuId("GPU-0"), GpuId("GPU-1")


@pytest.fixture
def two_gpus() -> CoreDriver:
    return CoreDriver(8 * GIB, gpus=2)


def busy_and_pinned(two_gpus: CoreDriver) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """GPU 0 is in use above everybody, GPU 1 is pinned."""
    busy, used = held(two_gpus, "busy", 6, gpu="0", priority=99)
    busy.use_begin(used)
    keeper, pinned = held(two_gpus, "keeper", 6, gpu="1", evictable=False)
    return busy, used, keeper, pinned


# -- pins that end
@pytest.mark.parametrize("end", ["release", "death", "unpin"])
def test_a_gpu_whose_pin_ended_is_a_place_for_who_waits(two_gpus: CoreDriver, end: str) -> None:
    """Regression: whoever came while it was pinned waited for the other GPU only, for hours beside
    an empty one."""
    _, _, keeper, pinned = busy_and_pinned(two_gpus)
    if end == "unpin":
        keeper.unload(pinned)
        two_gpus.until(lambda: two_gpus.state(pinned) == "over")
        keeper, pinned = held(two_gpus, "another", 6, gpu="1")
        order_lease(two_gpus, "pin", pinned)
    waiter = two_gpus.consumer("w").acquire(5 * GIB)
    two_gpus.advance(1.0)
    assert two_gpus.state(waiter) == "queued"
    if end == "unpin":
        order_lease(two_gpus, "unpin", pinned)
        two_gpus.until(lambda: two_gpus.state(pinned) == "revoking", limit_s=1.0)
    if end == "death":
        keeper.die()
    else:
        keeper.unload(pinned)
    late = two_gpus.consumer("late").acquire(5 * GIB, gpu="1") if end != "unpin" else None
    two_gpus.until(lambda: two_gpus.state(waiter) == "loading", limit_s=2.0)
    assert place(two_gpus, waiter) == ONE
    assert late is None or two_gpus.state(late) == "queued", "who came first is first there too"


def order_lease(two_gpus: CoreDriver, action: str, lease: LeaseId) -> None:
    ops = two_gpus.consumer("ops")
    ops.order(action, lease)


def test_whoever_names_another_gpu_or_is_too_large_waits_only_where_it_may_be(
    two_gpus: CoreDriver,
) -> None:
    busy_and_pinned(two_gpus)
    named = two_gpus.consumer("named").acquire(5 * GIB, gpu="0")
    any_gpu = two_gpus.consumer("any").acquire(7 * GIB)
    waiting = two_gpus.arbiter.inspect().waiting
    assert (waiting[named].request.gpus, waiting[any_gpu].request.gpus) == ((ZERO,), (ZERO, ONE))


# -- away
def gone_for_policy(
    two_gpus: CoreDriver, **spec: Any
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """On standby, since a policy that is used on GPU 0."""
    det, lease = held(two_gpus, "det", 5, standby=True, **spec)
    policy = two_gpus.consumer("policy")
    wanted = policy.acquire(5 * GIB, gpu="0")
    det.unload(lease)
    two_gpus.until(lambda: two_gpus.state(wanted) == "loading")
    policy.load(wanted)
    policy.use_begin(wanted)
    two_gpus.advance(0.1)
    return det, lease, policy, wanted


def test_a_gpu_that_was_pinned_when_it_asked_is_one_to_come_back_to(two_gpus: CoreDriver) -> None:
    """Regression: where it may come back to was where it could have been granted when it asked."""
    keeper, pinned = held(two_gpus, "keeper", 6, gpu="1", evictable=False)
    _, lease, _, _ = gone_for_policy(two_gpus)
    two_gpus.advance(5.0)
    assert two_gpus.state(lease) == "standby"
    keeper.unload(pinned)
    two_gpus.until(lambda: two_gpus.state(lease) == "loading", limit_s=2.0)
    assert place(two_gpus, lease) == ONE


def test_after_a_restart_it_comes_back_to_any_gpu_still(two_gpus: CoreDriver) -> None:
    """Regression: a lease that was held when the daemon restarted could come back to its own GPU
    only."""
    det, lease = held(two_gpus, "det", 5, standby=True)
    other, fills = held(two_gpus, "other", 6, gpu="1")
    tokens = [det.token(lease), other.token(fills)]
    two_gpus.restart()
    for person, one, token in ((det, lease, tokens[0]), (other, fills, tokens[1])):
        person.connect()
        person.reattach(one, token)
    policy = two_gpus.consumer("policy")
    wanted = policy.acquire(5 * GIB, gpu="0")
    two_gpus.until(lambda: two_gpus.state(lease) == "revoking")
    det.unload(lease)
    two_gpus.until(lambda: two_gpus.state(wanted) == "loading")
    policy.load(wanted)
    policy.use_begin(wanted)
    other.unload(fills)
    two_gpus.until(lambda: two_gpus.state(lease) == "loading", limit_s=2.0)
    assert place(two_gpus, lease) == ONE


def test_a_lease_that_is_away_from_a_gpu_that_is_gone_ends(two_gpus: CoreDriver) -> None:
    """Regression: `status` and `why` of a lease without any GPU ended the daemon."""
    det, lease, _, wanted = gone_for_policy(two_gpus, gpu="GPU-0")
    token = det.token(lease)
    two_gpus.settings = replace(two_gpus.settings, gpus=two_gpus.settings.gpus[1:])
    del two_gpus.devices[ZERO]
    two_gpus.restart()
    assert two_gpus.state(lease) == "over"
    assert f"lease:{lease}" not in two_gpus.journal
    det.connect()
    (told,) = answer(det.reattach(lease, token, away=True))["leases"]
    assert (told["kept"], told["error"]["code"]) == (False, "lease_lost")
    assert (two_gpus.why("det")["leases"], two_gpus.state(wanted)) == ([], "over")
    _, other = held(two_gpus, "other", 5)
    assert place(two_gpus, other) == ONE, "the daemon grants"
