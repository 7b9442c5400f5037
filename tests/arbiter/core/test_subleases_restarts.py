"""Trees of leases over a restart of the daemon, with and without its journal."""

import pytest

from tests.support.core_driver import CoreDriver, answer
from tests.support.scenes import Tree
from vram_arbiter.schemas import defaults as d

GIB = d.GIB
MIB = d.MIB


def come_back(tree: Tree, *, held: bool = True) -> None:
    leaf = tree.policy.token(tree.leaf) if tree.state(tree.leaf) != "over" else None
    tree.driver.restart(epoch=tree.driver.settings.epoch + 1)
    tree.runner.connect()
    tree.policy.connect()
    answer(tree.runner.reattach(tree.root, tree.token, held=held))
    if leaf is not None:
        answer(tree.policy.reattach(tree.leaf, leaf, held=held))
    tree.driver.advance(0.01)


@pytest.mark.parametrize("held", [True, False])
def test_a_tree_survives_a_restart_of_the_daemon(tree: Tree, held: bool) -> None:
    if held:
        tree.held()
    come_back(tree, held=held)
    assert tree.charges() == [1 * GIB, 4 * GIB]
    assert tree.driver.view(tree.leaf)["parent"] == tree.root  # type: ignore[index]
    assert tree.state(tree.root) == ("held" if held else "loading")
    if not held:
        tree.held()
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB]


def test_a_residue_that_is_borne_survives_a_restart() -> None:
    tree = Tree(residue_bytes=450 * MIB).held()
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    come_back(tree)
    assert tree.charges(tree.root) == [5 * GIB - 450 * MIB]
    tree.policy.die()
    tree.driver.until(lambda: tree.charges(tree.root) == [5 * GIB])


def test_a_dead_childs_debt_survives_a_restart_and_comes_back_to_the_parent(tree: Tree) -> None:
    tree.held()
    tree.driver.card.lag_s = 3.0
    tree.policy.die()
    come_back(tree)
    assert tree.charges(tree.root) == [1 * GIB]
    tree.driver.until(lambda: tree.charges(tree.root) == [5 * GIB])


def test_a_dead_parents_child_is_a_root_after_a_restart_too(tree: Tree) -> None:
    tree.held()
    tree.driver.card.lag_s = 3.0
    tree.runner.die()
    leaf = tree.policy.token(tree.leaf)
    tree.driver.restart()
    tree.policy.connect()
    answer(tree.policy.reattach(tree.leaf, leaf))
    tree.driver.advance(5.0)
    assert "parent" not in (tree.driver.view(tree.leaf) or {})
    assert tree.total() == 4 * GIB


def test_an_empty_card_does_not_void_a_reservation(tree: Tree) -> None:
    """A restart between two models of a tree: nothing is on the card, and the tree has its bytes all the same."""
    tree.held()
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    tree.driver.restart()
    tree.driver.advance(0.5)
    assert tree.charges(tree.root) == [5 * GIB]
    tree.runner.connect()
    answer(tree.runner.reattach(tree.root, tree.token))
    assert tree.state(tree.root) == "held"


def test_a_child_that_does_not_come_back_to_an_empty_card_gives_its_bytes_back_in_time() -> None:
    tree = Tree(ttl_s=10.0).held()
    tree.driver.card.held.clear()
    tree.driver.restart()
    tree.runner.connect()
    answer(tree.runner.reattach(tree.root, tree.token))
    waiter = tree.driver.consumer("w")
    wanted = waiter.acquire(5 * GIB)
    tree.driver.advance(14.0)
    assert tree.driver.arbiter.status(tree.driver.now)["phase"] == "serving"
    states = (tree.state(tree.root), tree.state(tree.leaf))
    assert states == ("held", "held"), "a tree is not asked before all of it is heard of"
    (one,) = tree.driver.arbiter.why("w", tree.driver.now)["leases"]
    told = {blocker["lease_id"]: blocker["condition"] for blocker in one["blockers"]}
    assert f"waits for policy ({tree.leaf}) to come back" in told[tree.root]
    assert told[tree.leaf].startswith("has not come back since the restart")
    tree.driver.until(lambda: tree.state(tree.leaf) == "over", limit_s=2.0)
    tree.driver.until(lambda: tree.state(wanted) == "loading", limit_s=1.0)
    assert tree.state(tree.root) == "over", "a reservation and no more: nobody has to unload it"


def test_an_eviction_under_way_begins_anew_after_a_restart_for_the_whole_tree(tree: Tree) -> None:
    """Uses of others may be on their way back, so nobody counts as asked before the new daemon asks."""
    tree.held()
    waiter = tree.driver.consumer("w")
    waiter.acquire(5 * GIB)
    before = len(tree.driver.pushes("revoke"))
    come_back(tree)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("held", "held")
    waiter.connect()
    waiter.acquire(5 * GIB, key="again")
    tree.driver.advance(0.1)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("revoking", "revoking")
    asked = [push["lease_id"] for push in tree.driver.pushes("revoke")[before:]]
    assert {tree.root, tree.leaf} == set(asked)
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.root) == "over")


def test_a_parent_on_standby_comes_back_as_a_reservation() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB, standby=True)
    leaf = policy.acquire(4 * GIB, standby=True, parent=(root, runner.token(root)))
    policy.load(leaf)
    driver.advance(0.01)
    other = driver.consumer("other")
    waiter = other.acquire(5 * GIB)
    policy.unload(leaf)
    driver.until(lambda: driver.state(waiter) == "loading")
    driver.until(lambda: driver.state(root) == "standby")
    assert driver.state(leaf) == "over", "only its parent comes back, for all of the tree"
    assert driver.pushes("lost") == []
    other.load(waiter)
    driver.advance(0.01)
    other.unload(waiter)
    driver.until(lambda: driver.state(root) == "loading")
    assert driver.state(policy.acquire(5 * GIB, parent=(root, runner.token(root)))) == "loading"


@pytest.mark.parametrize("parent_first", [True, False])
def test_a_tree_is_adopted_from_its_holders_when_the_journal_is_lost(
    tree: Tree, parent_first: bool
) -> None:
    tree.held()
    leaf = tree.policy.token(tree.leaf)
    tree.driver.restart(keep_journal=False)
    tree.runner.connect()
    tree.policy.connect()
    steps = [
        lambda: tree.runner.reattach(tree.root, tree.token),
        lambda: tree.policy.reattach(tree.leaf, leaf),
    ]
    for step in steps if parent_first else reversed(steps):
        answer(step())
    assert tree.charges() == [1 * GIB, 4 * GIB]
    assert tree.driver.view(tree.leaf)["parent"] == tree.root  # type: ignore[index]


def test_a_share_whose_lease_is_not_in_the_journal_is_not_handed_out_again(tree: Tree) -> None:
    tree.held()
    record = dict(tree.driver.journal[f"lease:{tree.root}"])
    estate = record["estate"]
    whole = estate["booked_bytes"] + MIB
    shares = {**estate["shares"], "L0-7": [MIB, MIB, 0]}
    record["estate"] = {**estate, "booked_bytes": whole, "approved_bytes": whole, "shares": shares}
    tree.driver.journal[f"lease:{tree.root}"] = record
    come_back(tree)
    assert tree.total() == 5 * GIB
    assert tree.charges() == [1 * GIB, 4 * GIB]
