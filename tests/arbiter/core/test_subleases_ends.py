"""How a tree of leases comes to its end: evictions, releases, and what becomes of it when somebody dies."""

from tests.support.core_driver import CoreDriver, answer, refusal
from tests.support.scenes import Tree, revokes
from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

GIB = d.GIB
MIB = d.MIB


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
    tree.driver.post(
        OperatorAsked(ops.client, tree.driver.next_request(), "evict", tree.root, "ops", "test")
    )
    assert (tree.state(second), tree.state(tree.leaf)) == ("loading", "revoking")
    assert revokes(other.ready(second)) == [(second, 0, 0)]
    push = tree.driver.pushes("revoke", second)[-1]
    assert (push["wanted_by"], push["cause"]) == ("", "parent")


def test_a_tree_with_a_pinned_lease_is_pinned(tree: Tree) -> None:
    tree = Tree(evictable=False).held()
    waiter = tree.driver.consumer("w").acquire(5 * GIB)
    tree.driver.advance(10.0)
    assert tree.state(waiter) == "queued"
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
    assert (driver.state(leaf), driver.state(waiter)) == ("over", "queued"), (
        "its bytes are still there"
    )
    driver.until(lambda: driver.state(root) == "over")
    policy.die()
    driver.until(lambda: driver.state(waiter) == "loading", limit_s=10.0)


def test_a_parent_in_use_is_not_given_up_when_its_last_child_dies_in_an_eviction(
    tree: Tree,
) -> None:
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


def test_a_sub_lease_whose_record_cannot_be_written_is_refused_and_its_parent_stays(
    tree: Tree,
) -> None:
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
    assert (tree.state(tree.leaf), tree.total()) == ("over", 5 * GIB)


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


def test_what_a_sub_lease_took_beyond_its_share_is_not_approved_for_its_parent() -> None:
    """Else the parent that leaves after it keeps more approved than booked, and who fits beside the booking breaks invariant 1."""
    tree = Tree()
    tree.policy.hold(int(4.5 * GIB))
    tree.policy.ready(tree.leaf, int(4.5 * GIB))
    assert tree.charges() == [GIB // 2, int(4.5 * GIB)]
    tree.runner.hold(GIB // 2)
    tree.driver.advance(0.1)
    tree.runner.unload(tree.root)
    tree.runner.hold(GIB // 2)
    other = tree.driver.consumer("other").acquire(7 * GIB)
    tree.policy.unload(tree.leaf)
    tree.driver.until(lambda: tree.state(other) == "loading", limit_s=20.0)
