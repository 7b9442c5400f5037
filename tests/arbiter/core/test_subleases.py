"""Sub-leases: bytes that a lease lends, a tree that is one unit to everybody else, and what becomes of it when somebody dies."""

from typing import Any

import pytest

from arbiter.core.effects import Push, Reply
from arbiter.core.events import OperatorAsked
from arbiter.testing.core_driver import Consumer, CoreDriver, answer, refusal
from schemas import defaults as d
from schemas.ids import LeaseId, Token

GIB = d.GIB
MIB = d.MIB


class Tree:
    """A runner that reserves 5 GiB and a policy that loads under it, on a card of 8 GiB."""

    def __init__(
        self, driver: CoreDriver | None = None, steady: int = 5 * GIB, stay_s: float = 0.0, **child: Any
    ) -> None:
        self.driver = driver or CoreDriver(8 * GIB)
        self.runner = self.driver.consumer("runner")
        self.policy = self.driver.consumer("policy")
        self.root = self.runner.acquire(5 * GIB, steady, min_residency_s=stay_s)
        self.token = self.runner.token(self.root)
        self.leaf = self.carve(self.policy, 4 * GIB, **child)

    def carve(self, who: Consumer, count: int, *spec: Any, **more: Any) -> LeaseId:
        return who.acquire(count, *spec, **{"parent": (self.root, self.token), **more})

    def held(self) -> "Tree":
        self.policy.load(self.leaf)
        self.driver.advance(0.01)
        return self

    def charges(self, *leases: LeaseId) -> list[int]:
        views = [self.driver.view(lease) for lease in leases or (self.root, self.leaf)]
        return [0 if view is None else view["charge_bytes"] for view in views]

    def state(self, lease: LeaseId) -> str:
        return self.driver.state(lease)

    def total(self) -> int:
        return int(self.driver.gpu()["charged_bytes"])


@pytest.fixture
def tree() -> Tree:
    return Tree()


def revokes(effects: list[Any]) -> list[tuple[str, int, int]]:
    pushed = [e.body for e in effects if isinstance(e, Push) and e.body["push"] == "revoke"]
    return [(p["lease_id"], p["uses"], p.get("children", 0)) for p in pushed]


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
    refused = refusal(tree.driver.consumer("x").try_acquire(2 * GIB, parent=(tree.root, tree.token)))
    assert refused.code == "parent_too_small"
    assert refused.details == {"needed_bytes": 2 * GIB, "left_bytes": 1 * GIB}
    assert tree.total() == 5 * GIB


def test_what_the_parents_own_process_holds_is_not_left(tree: Tree) -> None:
    tree.held()
    tree.runner.hold(700 * MIB)
    tree.driver.advance(1.5)
    refused = refusal(tree.driver.consumer("x").try_acquire(512 * MIB, parent=(tree.root, tree.token)))
    assert refused.details["left_bytes"] == 1 * GIB - 700 * MIB


def test_a_parent_that_says_what_it_holds_has_that_much_less() -> None:
    driver = CoreDriver(8 * GIB)
    driver.card.lists_processes = False
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB)
    runner.load(root, 4 * GIB)
    refused = refusal(driver.consumer("x").try_acquire(512 * MIB, parent=(root, runner.token(root))))
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


def test_a_sub_lease_that_holds_more_than_it_said_takes_it_from_its_parent_first(tree: Tree) -> None:
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


def test_a_parent_that_says_ready_itself_keeps_what_it_holds_beside_its_sub_leases(tree: Tree) -> None:
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
    assert revokes(effects) == [(tree.leaf, 0, 0), (tree.root, 0, 1)], "the leaf first, both may leave now"


def test_a_waiter_of_lower_priority_does_not_ask_a_tree_in_use(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.root, "goal")
    tree.driver.consumer("w").acquire(5 * GIB, priority=40)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("held", "held")


def test_an_idle_sub_lease_may_not_unload_under_a_goal_but_beside_a_busy_sibling_it_may(tree: Tree) -> None:
    tree.held()
    other = tree.driver.consumer("other")
    second = tree.carve(other, 512 * MIB)
    other.ready(second)
    tree.runner.use_begin(tree.root, "goal")
    assert refusal(other.unloading(second)).code == "bad_state"
    tree.runner.use_end(tree.root, "goal")
    tree.policy.use_begin(tree.leaf)
    answer(other.unloading(second))


# -- leaving -----------------------------------------------------------------------------------------------------------
def test_eviction_asks_the_leaf_first_tells_the_root_and_needs_no_word_of_a_mere_reservation(
    tree: Tree,
) -> None:
    tree.held()
    effects = tree.driver.consumer("w").try_acquire(5 * GIB)
    assert revokes(effects) == [(tree.leaf, 0, 0), (tree.root, 0, 1)]
    waiter = LeaseId(answer(effects)["lease"]["lease_id"])
    refused = refusal(tree.runner.unloading(tree.root))
    assert (refused.code, refused.details["children"]) == ("bad_state", 1), "its sub-lease is there"
    assert refusal(tree.policy.use_begin(tree.leaf)).code == "lease_revoking"
    assert (
        refusal(tree.driver.consumer("x").try_acquire(1, parent=(tree.root, tree.token))).code
        == "lease_revoking"
    )
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(waiter) == "loading")
    tree.driver.until(lambda: tree.state(tree.root) == "over", limit_s=0.2)
    (lost,) = tree.driver.pushes("lost", tree.root)
    assert lost["error"]["code"] == "lease_lost"
    assert tree.driver.notes("granted")[-1]["evicted"] == ["policy"], (
        "the rest of the reservation was not needed"
    )
    assert answer(tree.runner.release(tree.root, token=tree.token))["state"] == "released", (
        "late words are fine"
    )


def test_acknowledged_pushes_to_a_parent_stop_until_its_sub_leases_are_gone(tree: Tree) -> None:
    tree.held()
    tree.runner.hold(512 * MIB)
    tree.driver.advance(1.5)
    tree.driver.consumer("w").acquire(7 * GIB)
    tree.runner.ack(tree.root)
    tree.policy.ack(tree.leaf)
    before = len(tree.driver.pushes("revoke", tree.root))
    tree.driver.advance(1.0)
    assert len(tree.driver.pushes("revoke", tree.root)) == before
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert len(tree.driver.pushes("revoke", tree.root)) == before + 1, (
        "it holds bytes itself: it has to unload them"
    )
    assert tree.state(tree.root) == "revoking"
    tree.runner.unload(tree.root)
    tree.driver.until(lambda: tree.state(tree.root) == "over")


def test_a_voluntary_release_gives_the_bytes_back_to_the_reservation(tree: Tree) -> None:
    tree.held()
    tree.policy.unload(tree.leaf)
    assert tree.charges() == [1 * GIB, 4 * GIB], (
        "until they are measured gone they are charged where they were"
    )
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB]
    assert tree.state(tree.root) == "held"
    again = tree.carve(tree.policy, 5 * GIB)
    assert tree.state(again) == "loading"


def test_bytes_that_return_to_a_reservation_are_promised_to_nobody_else(tree: Tree) -> None:
    tree.held()
    tree.driver.card.lag_s = 5.0
    tree.policy.unload(tree.leaf)
    waiter = tree.driver.consumer("w").acquire(4 * GIB)
    tree.driver.advance(0.1)
    assert tree.state(tree.root) == "revoking", (
        "the whole tree is asked: what its leaf frees is not the waiter's"
    )
    tree.driver.until(lambda: tree.state(waiter) == "loading")


def test_a_residue_stays_borne_by_the_parent_until_its_process_gives_it_up() -> None:
    tree = Tree(residue_bytes=450 * MIB).held()
    other = tree.driver.consumer("other")  # another tree on the card: it bears nothing of this one
    root = other.acquire(1 * GIB)
    tree.driver.consumer("leaf").acquire(512 * MIB, parent=(root, other.token(root)))
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB - 450 * MIB]
    assert tree.total() == 6 * GIB
    leaf = tree.carve(tree.policy, 5 * GIB, residue_bytes=450 * MIB)
    assert tree.charges(tree.root) == [0], "the context is part of the load, not on top of it"
    tree.policy.load(leaf)
    tree.driver.advance(0.01)
    tree.policy.unload(leaf)
    tree.driver.until(lambda: tree.state(leaf) == "over")
    tree.policy.die()
    tree.driver.until(lambda: tree.charges(tree.root) == [5 * GIB])
    assert tree.total() == 6 * GIB


def test_a_residue_that_becomes_part_of_a_lease_of_its_own_never_comes_back_to_the_parent() -> None:
    tree = Tree(residue_bytes=450 * MIB).held()
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    own = tree.policy.acquire(2 * GIB, residue_bytes=450 * MIB)
    tree.driver.until(lambda: tree.state(own) == "loading")
    assert tree.charges(tree.root, own) == [5 * GIB - 450 * MIB, 2 * GIB]
    tree.policy.load(own)
    tree.policy.die()
    tree.driver.advance(2.0)
    assert tree.total() == 5 * GIB - 450 * MIB


def test_a_leftover_that_shrinks_later_is_the_parents_again(tree: Tree) -> None:
    tree.held()
    tree.policy.unloading(tree.leaf)
    tree.policy.hold(GIB)  # it does not free what it said
    tree.policy.release(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [4 * GIB]
    tree.policy.hold(300 * MIB)
    tree.driver.advance(2.5)
    assert tree.charges(tree.root) == [5 * GIB - 300 * MIB]
    tree.policy.hold(0)
    tree.driver.advance(2.5)
    assert tree.charges(tree.root) == [5 * GIB]


def test_a_parent_that_lets_go_asks_its_sub_leases_first(tree: Tree) -> None:
    tree.held()
    tree.policy.use_begin(tree.leaf)
    effects = tree.runner.release(tree.root)
    assert answer(effects)["state"] == "revoking"
    assert revokes(effects) == [(tree.leaf, 1, 0)]
    assert "its own wish" in tree.driver.arbiter.why("runner", tree.driver.now)["leases"][0]["text"]
    assert answer(tree.runner.release(tree.root))["state"] == "revoking", "said again it is fine"
    tree.driver.advance(60.0)
    assert tree.state(tree.leaf) == "revoking", "in use: nothing is done to it"
    tree.policy.use_end(tree.leaf)
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.root) == "over")
    assert tree.total() == 0


def test_a_parent_that_let_go_needs_no_renewal_any_more() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB, ttl_s=2.0)
    leaf = policy.acquire(4 * GIB, parent=(root, runner.token(root)))
    policy.load(leaf)
    runner.release(root)
    runner.renew((root, runner.token(root)))
    driver.advance(30.0)
    assert driver.state(root) == "revoking"


def test_a_parent_that_gives_up_while_its_sub_lease_loads(tree: Tree) -> None:
    effects = tree.runner.release(tree.root)
    assert answer(effects)["state"] == "revoking"
    assert revokes(effects) == []
    effects = tree.policy.load(tree.leaf)
    assert revokes(effects) == [(tree.leaf, 0, 0)], "ready, and asked in the same breath"
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.root) == "over")


def test_a_sub_lease_that_becomes_ready_in_a_tree_that_an_operator_evicts_is_asked_for_nobody(
    tree: Tree,
) -> None:
    tree.held()
    other = tree.driver.consumer("second")
    second = tree.carve(other, 512 * MIB)
    ops = tree.driver.consumer("ops")
    tree.driver.post(OperatorAsked(ops.client, tree.driver.next_request(), "evict", tree.root, "ops", "test"))
    assert (tree.state(second), tree.state(tree.leaf)) == ("loading", "revoking")
    assert revokes(other.ready(second)) == [(second, 0, 0)]
    assert tree.driver.pushes("revoke", second)[-1]["wanted_by"] == ""


def test_a_tree_with_a_pinned_lease_is_pinned(tree: Tree) -> None:
    tree = Tree(evictable=False).held()
    waiter = tree.driver.consumer("w").try_acquire(5 * GIB)
    assert refusal(waiter).code == "vram_insufficient"
    small = tree.driver.consumer("small").acquire(2 * GIB)
    assert tree.state(small) == "loading"


def test_a_tree_under_an_exclusive_root_is_alone_on_its_card() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(3 * GIB, exclusive=True)
    leaf = policy.acquire(2 * GIB, exclusive=True, parent=(root, runner.token(root)))
    policy.load(leaf)
    driver.advance(0.01)
    waiter = driver.consumer("w").acquire(1 * GIB)
    assert driver.state(root) == "revoking"
    policy.unload(leaf)
    driver.until(lambda: driver.state(waiter) == "loading")


# -- deaths ------------------------------------------------------------------------------------------------------------
def test_a_dead_childs_bytes_are_measured_gone_and_then_the_reservations(tree: Tree) -> None:
    tree.held()
    tree.driver.card.lag_s = 1.0
    tree.policy.die()
    assert tree.charges() == [1 * GIB, 0]
    assert tree.total() == 5 * GIB, "its debt is still charged"
    tree.driver.advance(0.5)
    assert tree.charges(tree.root) == [1 * GIB]
    tree.driver.until(lambda: tree.charges(tree.root) == [5 * GIB], limit_s=1.0)
    assert tree.carve(tree.driver.consumer("policy2"), 5 * GIB)


def test_a_debt_of_a_dead_child_is_not_counted_as_room_for_others(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.root, "goal")
    tree.driver.card.lag_s = 1.0
    tree.policy.die()
    waiter = tree.driver.consumer("w").acquire(4 * GIB, priority=10)
    tree.driver.advance(3.0)
    assert (tree.state(tree.root), tree.state(waiter)) == ("held", "queued")
    assert tree.charges(tree.root) == [5 * GIB]


def test_a_dead_parents_sub_lease_is_a_root_of_its_own(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.leaf, "goal", tree.policy.token(tree.leaf))
    tree.runner.die()
    tree.driver.advance(1.0)
    view = tree.driver.view(tree.leaf)
    assert view is not None
    assert (view["state"], view["uses"], "parent" in view) == ("held", 0, False)
    assert tree.total() == 4 * GIB, "the rest of the reservation is dropped"
    assert tree.driver.notes("orphaned")[-1]["parent"] == tree.root
    waiter = tree.driver.consumer("w").acquire(5 * GIB)
    assert tree.state(tree.leaf) == "revoking", "idle and evictable"
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(waiter) == "loading")


def test_an_orphan_in_use_finishes_first(tree: Tree) -> None:
    tree.held()
    tree.policy.use_begin(tree.leaf)
    tree.driver.consumer("w").acquire(5 * GIB)
    assert tree.state(tree.leaf) == "revoking"
    tree.runner.die()
    tree.driver.advance(5.0)
    assert tree.state(tree.leaf) == "revoking"
    effects = tree.policy.use_end(tree.leaf)
    assert revokes(effects) == [(tree.leaf, 0, 0)]


def test_an_orphan_that_only_its_parents_goal_kept_busy_hears_that_it_may_leave(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.root, "goal")
    tree.driver.consumer("w").acquire(5 * GIB)
    effects = tree.runner.die()
    assert (tree.leaf, 0, 0) in revokes(effects)


def test_a_parent_that_expires_leaves_its_sub_lease_as_it_is() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB, ttl_s=2.0)
    leaf = policy.acquire(4 * GIB, parent=(root, runner.token(root)))
    policy.load(leaf)
    driver.advance(30.0)
    assert (driver.state(root), driver.state(leaf)) == ("over", "held")
    assert driver.gpu()["charged_bytes"] == 4 * GIB


def test_a_hung_child_that_expires_in_an_eviction_does_not_hold_its_parent_for_ever() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB)
    leaf = policy.acquire(4 * GIB, ttl_s=2.0, parent=(root, runner.token(root)))
    policy.load(leaf)
    driver.advance(0.01)
    waiter = driver.consumer("w").acquire(5 * GIB)
    driver.advance(2.0)
    assert (driver.state(leaf), driver.state(waiter)) == ("over", "queued"), "its bytes are still there"
    driver.until(lambda: driver.state(root) == "over")
    policy.die()
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=10.0)


def test_a_parent_in_use_is_not_given_up_when_its_last_child_dies_in_an_eviction(tree: Tree) -> None:
    tree.held()
    tree.runner.use_begin(tree.root, "goal")
    tree.driver.consumer("w").acquire(5 * GIB)
    tree.policy.die()
    tree.driver.advance(1.0)
    assert tree.state(tree.root) == "revoking"
    tree.runner.use_end(tree.root, "goal")
    tree.driver.until(lambda: tree.state(tree.root) == "over")


def test_a_parent_that_says_bye_leaves_roots(tree: Tree) -> None:
    tree.held()
    tree.runner.leave()
    tree.driver.advance(1.0)
    assert (tree.state(tree.root), tree.state(tree.leaf)) == ("over", "held")
    assert tree.total() == 4 * GIB


def test_a_sub_lease_that_fails_to_load_gives_everything_back(tree: Tree) -> None:
    tree.policy.release(tree.leaf)
    tree.driver.until(lambda: tree.state(tree.leaf) == "over")
    assert tree.charges(tree.root) == [5 * GIB]
    assert tree.state(tree.root) == "loading"


def test_a_sub_lease_whose_record_cannot_be_written_is_refused_and_its_parent_stays(tree: Tree) -> None:
    tree.driver.journal_failing = "disk full"
    tree.driver.consumer("x").try_acquire(512 * MIB, parent=(tree.root, tree.token))
    tree.driver.journal_failing = ""
    assert tree.charges() == [1 * GIB, 4 * GIB]
    assert tree.driver.view(tree.root)["children"] == [tree.leaf]  # type: ignore[index]
    assert "journal_unavailable" in [getattr(e, "code", "") for e in tree.driver.effects]


def test_without_process_lists_a_reservation_is_released_by_the_totals(tree: Tree) -> None:
    driver = CoreDriver(8 * GIB)
    driver.card.lists_processes = False
    tree = Tree(driver).held()
    waiter = driver.consumer("w").acquire(5 * GIB)
    tree.policy.unload(tree.leaf)
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=2.0)
    driver.until(lambda: tree.state(tree.root) == "over", limit_s=0.2)


def test_without_process_lists_a_parent_that_said_ready_has_to_release_itself() -> None:
    driver = CoreDriver(8 * GIB)
    driver.card.lists_processes = False
    tree = Tree(driver)
    tree.runner.ready(tree.root)
    tree.held()
    driver.consumer("w").acquire(5 * GIB)
    tree.policy.unload(tree.leaf)
    driver.until(lambda: tree.state(tree.leaf) == "over")
    driver.advance(1.0)
    assert tree.state(tree.root) == "revoking"
    tree.runner.unload(tree.root)
    driver.until(lambda: tree.state(tree.root) == "over")


def test_a_parent_that_said_what_it_holds_is_not_given_up_by_the_engine() -> None:
    driver = CoreDriver(8 * GIB)
    runner, policy = driver.consumer("runner"), driver.consumer("policy")
    root = runner.acquire(5 * GIB)
    leaf = policy.acquire(4 * GIB, parent=(root, runner.token(root)))
    runner.ready(root, 256 * MIB)
    policy.load(leaf)
    driver.advance(0.01)
    driver.consumer("w").acquire(5 * GIB)
    policy.unload(leaf)
    driver.advance(2.0)
    assert (driver.state(leaf), driver.state(root)) == ("over", "revoking")


def test_a_carve_before_the_first_reading_goes_by_what_is_charged() -> None:
    driver = CoreDriver(8 * GIB)
    runner = driver.consumer("runner")
    root = runner.acquire(5 * GIB)
    token = runner.token(root)
    driver.card.silent = True
    driver.restart()
    leaf = driver.consumer("policy").acquire(5 * GIB, parent=(root, token))
    assert driver.view(root)["charge_bytes"] == 0, driver.view(leaf)  # type: ignore[index]


# -- restarts ----------------------------------------------------------------------------------------------------------
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


def test_a_child_that_the_empty_card_voids_gives_its_bytes_back(tree: Tree) -> None:
    tree.held()
    tree.driver.card.held.clear()
    tree.driver.restart()
    tree.driver.advance(0.1)
    assert tree.state(tree.leaf) == "over"
    assert tree.charges(tree.root) == [5 * GIB]


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
def test_a_tree_is_adopted_from_its_holders_when_the_journal_is_lost(tree: Tree, parent_first: bool) -> None:
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


# -- lines of three ----------------------------------------------------------------------------------------------------
def test_a_grandchild_takes_from_its_parent_and_its_grandparent_knows_nothing_of_it(tree: Tree) -> None:
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
