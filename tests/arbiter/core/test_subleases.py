"""Sub-leases: bytes that a lease lends, and a tree that is one unit to everybody else."""

from typing import Any

import pytest

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import Tree, revokes
from vram_arbiter.arbiter.core.effects import Reply
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, Token

GIB = d.GIB
MIB = d.MIB


# -- carving -----------------------------------------------------------------------------------------------------------
def test_a_sub_lease_is_granted_at_once_out_of_its_parents_charge(tree: Tree) -> None:
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("loading", "loading")
    assert tree.charges() == [1 * GIB, 4 * GIB]
    assert tree.total() == 5 * GIB, "the total never grows by it"
    view = tree.driver.view(tree.leaf)
    assert view is not None
    assert view["parent"] == tree.root
    assert view["pid"] == tree.policy.process.pid
    assert tree.driver.view(tree.root)["children"] == [tree.leaf]  # type: ignore[index]
    note = tree.driver.notes("granted")[-1]
    assert (note["parent"], note["waited_ms"]) == (tree.root, 0.0)
    assert "carved out of runner" in note["reason"]


def test_its_token_is_newer_and_its_record_is_written_before_it_is_told(tree: Tree) -> None:
    assert tree.policy.token(tree.leaf) > tree.token
    effects = tree.driver.consumer("x").try_acquire(GIB, parent=(tree.root, tree.token))
    assert [type(e).__name__ for e in effects] == ["JournalPut", "JournalPut", "Reply", "Note"]


def test_asked_again_by_its_nonce_it_is_the_same_sub_lease(tree: Tree) -> None:
    spec: dict[str, Any] = {"parent": (tree.root, tree.token), "nonce": "again"}
    first = tree.policy.acquire(512 * MIB, **spec)
    again = answer(tree.policy.try_acquire(512 * MIB, **spec))
    assert (again["lease"]["lease_id"], again["state"]) == (first, "loading")
    assert tree.total() == 5 * GIB


def test_more_than_is_left_is_refused_with_both_figures(tree: Tree) -> None:
    refused = refusal(
        tree.driver.consumer("x").try_acquire(2 * GIB, parent=(tree.root, tree.token))
    )
    assert refused.code == "parent_too_small"
    assert refused.details == {"needed_bytes": 2 * GIB, "left_bytes": 1 * GIB}
    assert tree.total() == 5 * GIB


def test_what_the_parents_own_process_holds_is_not_left(tree: Tree) -> None:
    tree.held()
    tree.runner.hold(700 * MIB)
    tree.driver.advance(1.5)
    refused = refusal(
        tree.driver.consumer("x").try_acquire(512 * MIB, parent=(tree.root, tree.token))
    )
    assert refused.details["left_bytes"] == 1 * GIB - 700 * MIB


def test_a_parent_that_says_what_it_holds_has_that_much_less() -> None:
    driver = CoreDriver(8 * GIB)
    driver.card.lists_processes = False
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB)
    runner.load(root, 4 * GIB)
    refused = refusal(
        driver.consumer("x").try_acquire(512 * MIB, parent=(root, runner.token(root)))
    )
    assert refused.details["left_bytes"] == 0


def test_only_the_exact_token_of_a_live_parent_carves(tree: Tree) -> None:
    x = tree.driver.consumer("x")
    stale = Token(tree.token.epoch, tree.token.serial + 7)
    assert refusal(x.try_acquire(1, parent=(tree.root, stale))).code == "stale_token"
    assert refusal(x.try_acquire(1, parent=(LeaseId("L9-9"), stale))).code == "unknown_lease"
    waiting = tree.driver.consumer("w").acquire(6 * GIB)
    assert refusal(x.try_acquire(1, parent=(waiting, stale))).code == "bad_state"


def test_a_sub_lease_is_on_its_parents_card() -> None:
    driver = CoreDriver(8 * GIB, cards=2)
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB, gpu="1")
    x = driver.consumer("x")
    spec = {"parent": (root, runner.token(root))}
    assert refusal(x.try_acquire(GIB, gpu="0", **spec)).code == "bad_request"
    lease = x.acquire(GIB, gpu="1", **spec)
    assert driver.view(lease)["gpu"] == "GPU-1"  # type: ignore[index]


def test_lines_are_four_long_at_most(tree: Tree) -> None:
    above, who = tree.leaf, tree.policy
    for n in range(2):
        below = tree.driver.consumer(f"n{n}")
        above, who = below.acquire(2 * GIB - n * GIB, parent=(above, who.token(above))), below
    refused = refusal(tree.driver.consumer("deep").try_acquire(1, parent=(above, who.token(above))))
    assert (refused.code, refused.details["limit"]) == ("limit_exceeded", "sublease_depth_max")
    assert tree.total() == 5 * GIB


def test_a_context_that_its_process_has_already_is_not_taken_again() -> None:
    """A residue that was there before is folded: the parent gives only what is on top, and gets no more back."""
    driver = CoreDriver(8 * GIB)
    policy = driver.consumer("policy")
    early = policy.acquire(GIB, residue_bytes=400 * MIB)
    policy.load(early)
    driver.advance(0.01)
    policy.unload(early)
    driver.until(lambda: driver.state(early) == "over")
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB)
    before = driver.gpu()["charged_bytes"]
    leaf = policy.acquire(4 * GIB, residue_bytes=400 * MIB, parent=(root, runner.token(root)))
    assert driver.view(root)["charge_bytes"] == 5 * GIB - (4 * GIB - 400 * MIB)  # type: ignore[index]
    assert driver.gpu()["charged_bytes"] == before
    policy.load(leaf)
    driver.advance(0.01)
    policy.unload(leaf)
    driver.until(lambda: driver.state(leaf) == "over")
    assert driver.view(root)["charge_bytes"] == 5 * GIB  # type: ignore[index]
    assert driver.gpu()["charged_bytes"] == before


# -- becoming ready ----------------------------------------------------------------------------------------------------
def test_a_loading_parent_becomes_ready_with_its_sub_lease(tree: Tree) -> None:
    tree.policy.load(tree.leaf, 3 * GIB)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("held", "held")
    assert tree.charges() == [2 * GIB, 3 * GIB]
    assert [n["lease_id"] for n in tree.driver.notes("ready")] == [tree.leaf, tree.root]
    assert [n["lease_id"] for n in tree.driver.notes("switch")] == [tree.leaf, tree.root]


def test_the_whole_tree_is_one_load_and_others_wait_for_it(tree: Tree) -> None:
    waiter = tree.driver.consumer("w").acquire(2 * GIB)
    tree.driver.advance(5.0)
    assert tree.state(waiter) == "queued"
    tree.policy.load(tree.leaf)
    tree.driver.until(lambda: tree.state(waiter) == "loading", limit_s=1.0)


def test_a_load_under_a_held_parent_keeps_others_out_while_it_lasts(tree: Tree) -> None:
    tree.held()
    second = tree.carve(tree.driver.consumer("second"), GIB)
    waiter = tree.driver.consumer("w").acquire(2 * GIB)
    tree.driver.advance(5.0)
    assert (tree.state(second), tree.state(waiter)) == ("loading", "queued")


def test_a_sub_lease_that_holds_more_than_it_said_takes_it_from_its_parent_first(
    tree: Tree,
) -> None:
    tree.policy.load(tree.leaf, 4 * GIB + 512 * MIB)
    assert tree.charges() == [512 * MIB, 4 * GIB + 512 * MIB]
    tree.driver.advance(0.5)
    assert tree.driver.gpu()["pressure_bytes"] == 0
    tree.policy.hold(7 * GIB)
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB]


def test_more_than_the_whole_tree_is_pressure_and_is_not_kept_when_it_goes() -> None:
    tree = Tree(stay_s=60.0)  # else it is asked to relieve the card
    tree.policy.load(tree.leaf, 8 * GIB)
    tree.driver.advance(0.1)
    assert tree.driver.gpu()["pressure_bytes"] > 0
    assert tree.charges() == [0, 8 * GIB]
    tree.policy.hold(0)
    tree.policy.release(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB]


def test_a_parent_that_says_ready_itself_keeps_what_it_holds_beside_its_sub_leases(
    tree: Tree,
) -> None:
    tree.runner.ready(tree.root, 512 * MIB)
    assert tree.charges() == [1 * GIB, 4 * GIB], "its steady bytes cover both"
    assert tree.state(tree.leaf) == "loading"


def test_a_parent_keeps_its_steady_bytes_once_it_is_ready() -> None:
    tree = Tree(steady=4 * GIB + 256 * MIB).held()
    assert tree.charges() == [256 * MIB, 4 * GIB]


# -- in use ------------------------------------------------------------------------------------------------------------
@pytest.mark.parametrize("on", ["root", "leaf"])
def test_a_tree_is_in_use_while_any_of_it_is(tree: Tree, on: str) -> None:
    tree.held()
    lease, owner = (tree.root, tree.runner) if on == "root" else (tree.leaf, tree.policy)
    tree.runner.use_begin(lease, "goal", owner.token(lease))
    waiter = tree.driver.consumer("w").acquire(5 * GIB, priority=50)
    assert list(map(tree.state, (tree.root, tree.leaf, waiter))) == [
        "revoking",
        "revoking",
        "queued",
    ]
    assert [p["uses"] for p in tree.driver.pushes("revoke")][-2:] == [1, 1]
    tree.driver.advance(40.0)
    refused = refusal(tree.policy.unloading(tree.leaf))
    assert (refused.code, refused.details["uses"]) == ("bad_state", 1), (
        "a holder waits while it is told of uses"
    )
    assert "1 use" in tree.driver.arbiter.why("w", tree.driver.now)["leases"][0]["text"]
    effects = tree.runner.use_end(lease, "goal", owner.token(lease))
    assert revokes(effects) == [(tree.leaf, 0, 0), (tree.root, 0, 1)], (
        "the leaf first, both may leave now"
    )


def test_a_waiter_of_lower_priority_does_not_ask_a_tree_in_use(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.root, "goal")
    tree.driver.consumer("w").acquire(5 * GIB, priority=40)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("held", "held")


def test_an_idle_sub_lease_may_not_unload_under_a_goal_but_beside_a_busy_sibling_it_may(
    tree: Tree,
) -> None:
    tree.held()
    other = tree.driver.consumer("other")
    second = tree.carve(other, 512 * MIB)
    other.ready(second)
    tree.runner.use_begin(tree.root, "goal")
    assert refusal(other.unloading(second)).code == "bad_state"
    tree.runner.use_end(tree.root, "goal")
    tree.policy.use_begin(tree.leaf)
    answer(other.unloading(second))


# -- lines of three ----------------------------------------------------------------------------------------------------
def test_a_grandchild_takes_from_its_parent_and_its_grandparent_knows_nothing_of_it(
    tree: Tree,
) -> None:
    worker = tree.driver.consumer("worker")
    grandchild = worker.acquire(3 * GIB, parent=(tree.leaf, tree.policy.token(tree.leaf)))
    assert tree.charges(tree.root, tree.leaf, grandchild) == [1 * GIB, 1 * GIB, 3 * GIB]
    worker.load(grandchild, 2 * GIB)
    assert [tree.state(lease) for lease in (tree.root, tree.leaf, grandchild)] == ["held"] * 3
    assert tree.charges(tree.root, tree.leaf, grandchild) == [1 * GIB, 2 * GIB, 2 * GIB]
    tree.driver.advance(0.01)
    effects = tree.driver.consumer("w").try_acquire(5 * GIB)
    assert [lease for lease, _, _ in revokes(effects)] == [grandchild, tree.leaf, tree.root]
    worker.unload(grandchild)
    waiter = LeaseId(next(e for e in effects if isinstance(e, Reply)).body["lease"]["lease_id"])
    tree.driver.until(lambda: tree.state(waiter) == "loading")


def test_an_inner_lease_that_lets_go_takes_its_own_line_along_and_no_more(tree: Tree) -> None:
    tree.policy.hold(2 * GIB)
    tree.policy.ready(tree.leaf)
    tree.driver.advance(1.5)
    worker, other = tree.driver.consumer("worker"), tree.driver.consumer("other")
    grandchild = worker.acquire(GIB, parent=(tree.leaf, tree.policy.token(tree.leaf)))
    worker.load(grandchild)
    sibling = tree.carve(other, 512 * MIB)
    other.load(sibling)
    other.use_begin(sibling)
    tree.driver.advance(0.1)
    effects = tree.policy.release(tree.leaf)
    assert revokes(effects) == [(grandchild, 0, 0)], "a busy sibling is none of its business"
    worker.unload(grandchild)
    tree.policy.hold(0)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert (tree.state(tree.root), tree.state(sibling)) == ("held", "held")
    assert tree.charges(tree.root) == [5 * GIB - 512 * MIB]
