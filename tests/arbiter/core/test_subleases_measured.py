"""Sub-leases and the card itself: what comes back to a reservation is lent again at once, so it has to be gone; and a parent that
loads beside its sub-leases is no mere reservation."""

import pytest

from tests.support.core_driver import answer, refusal
from tests.support.scenes import hidden_card
from vram_arbiter.schemas import defaults as d

GIB = d.GIB
MIB = d.MIB


@pytest.mark.parametrize("of_its_own", [True, False])
def test_without_process_lists_bytes_are_lent_again_only_once_they_are_gone(
    of_its_own: bool,
) -> None:
    """No reading was taken while the sub-lease was ready: the ledger bound is all there is, and the reservation must not hide it."""
    driver = hidden_card(lists=False, lag_s=0.8)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(7 * GIB)
    token = runner.token(root)
    holder = runner if of_its_own else policy
    leaf = holder.acquire(2 * GIB, parent=(root, token))
    holder.load(leaf)
    driver.advance(0.0001)
    holder.unload(leaf)
    driver.advance(0.7)
    assert driver.state(leaf) == "verifying"
    assert refusal(policy.try_acquire(7 * GIB, parent=(root, token))).code == "parent_too_small"
    driver.until(lambda: driver.state(leaf) == "over", limit_s=0.3)
    assert sum(driver.card.shown(driver.now).values()) == 0
    policy.acquire(7 * GIB, parent=(root, token))


def test_without_process_lists_a_parent_that_is_ready_without_a_figure_lends_nothing() -> None:
    driver = hidden_card(lists=False)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB, 4 * GIB)
    runner.load(root)
    refused = refusal(policy.try_acquire(GIB, parent=(root, runner.token(root))))
    assert (refused.code, refused.details["left_bytes"]) == ("parent_too_small", 0)
    said = runner.acquire(3 * GIB)
    runner.ready(said, 256 * MIB)
    refused = refusal(policy.try_acquire(GIB, parent=(said, runner.token(said))))
    assert refused.details["left_bytes"] == 0, "it is charged what it said, and holds that"


@pytest.mark.parametrize("lists", [True, False])
@pytest.mark.parametrize("asked", [False, True])
def test_a_parent_that_is_ready_after_its_sub_lease_is_no_mere_reservation(
    lists: bool, asked: bool
) -> None:
    driver = hidden_card(lists=lists)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB)
    leaf = policy.acquire(2 * GIB, parent=(root, runner.token(root)))
    policy.load(leaf)
    assert driver.state(root) == "held", "with its sub-lease"
    if asked:
        driver.advance(0.01)
        driver.consumer("w").acquire(5 * GIB)
        assert driver.state(root) == "revoking"
    runner.hold(GIB)
    assert answer(runner.ready(root, GIB))["lease"]["state"] == driver.state(root)
    assert driver.view(root)["charge_bytes"] == 3 * GIB  # type: ignore[index]
    if not asked:
        driver.advance(0.01)
        driver.consumer("w").acquire(5 * GIB)
    policy.unload(leaf)
    driver.advance(2.0)
    assert driver.state(root) == "revoking", "it holds a gigabyte, and unloads it itself"
    runner.unload(root)
    driver.until(lambda: driver.state(root) == "over")


def test_a_parent_that_said_ready_is_no_mere_reservation_after_a_restart_either() -> None:
    driver = hidden_card(lists=False)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB)
    leaf = policy.acquire(2 * GIB, parent=(root, runner.token(root)))
    policy.load(leaf)
    runner.hold(2 * GIB)
    runner.ready(root)
    tokens = runner.token(root), policy.token(leaf)
    driver.restart()
    for who, lease, token in zip((runner, policy), (root, leaf), tokens, strict=True):
        who.connect()
        answer(who.reattach(lease, token))
    driver.advance(0.1)
    driver.consumer("w").acquire(5 * GIB)
    policy.unload(leaf)
    driver.advance(2.0)
    assert driver.state(root) == "revoking"


def test_a_ready_that_the_daemon_missed_counts_as_said() -> None:
    driver = hidden_card(lists=False)
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB, 4 * GIB)
    token = runner.token(root)
    driver.restart()
    runner.hold(4 * GIB)
    runner.connect()
    answer(runner.reattach(root, token))
    driver.advance(0.1)
    refused = refusal(driver.consumer("policy").try_acquire(GIB, parent=(root, token)))
    assert refused.details["left_bytes"] == 0
