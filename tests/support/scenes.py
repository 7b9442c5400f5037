"""Scenes that several files of the core's tests begin with: a resident holder, a detector that was sent away, a tree of leases."""

from typing import Any, Literal

from tests.support.core_driver import Consumer, CoreDriver
from vram_arbiter.arbiter.core.effects import Push
from vram_arbiter.arbiter.core.events import OperatorAsked
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId

GIB = d.GIB


def held(
    driver: CoreDriver, name: str, gib: float, person: Consumer | None = None, **spec: Any
) -> tuple[Consumer, LeaseId]:
    """Somebody and its lease, loaded."""
    person = person or driver.consumer(name)
    lease = person.acquire(int(gib * GIB), **spec)
    driver.until(lambda: driver.state(lease) == "loading")
    person.load(lease)
    driver.advance(0.01)
    return person, lease


def hidden_card(*, lists: bool = True, lag_s: float = 0.0) -> CoreDriver:
    """A card of 8 GiB as it is from the first reading on: with or without a list of processes, late by so much."""
    driver = CoreDriver(8 * GIB, start=False)
    driver.card.lists_processes = lists
    driver.card.lag_s = lag_s
    driver.advance(0.01)
    return driver


def shown(driver: CoreDriver, lease: LeaseId) -> dict[str, Any]:
    """A lease that is there, as `status` shows it."""
    view = driver.view(lease)
    assert view is not None
    return view


def charge(driver: CoreDriver, lease: LeaseId) -> int:
    return int(shown(driver, lease)["charge_bytes"])


def place(driver: CoreDriver, lease: LeaseId) -> str | None:
    """The card that it is on."""
    gpu: str | None = shown(driver, lease)["gpu"]
    return gpu


def why(driver: CoreDriver, consumer: str) -> dict[str, Any]:
    """What `why` says of a consumer with one lease."""
    found: dict[str, Any]
    (found,) = driver.arbiter.why(consumer, driver.now)["leases"]
    return found


def sent_away(
    driver: CoreDriver, gib: float = 5, policy_gib: float = 5, **spec: Any
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """A detector on standby, and the policy that it left for, resident."""
    det, lease = held(driver, "det", gib, standby=True, **spec)
    policy = driver.consumer("policy")
    wanted = policy.acquire(int(policy_gib * GIB))
    driver.until(lambda: driver.state(lease) == "revoking")
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(lease) == "standby"
    policy.load(wanted)
    driver.advance(0.01)
    return det, lease, policy, wanted


def order(driver: CoreDriver, action: Literal["evict", "pin"], lease: LeaseId) -> None:
    """An operator does this to a lease."""
    ops = driver.consumer("ops")
    driver.post(OperatorAsked(ops.client, driver.next_request(), action, lease, "ops", "test"))


class Tree:
    """A runner that reserves 5 GiB and a policy that loads under it, on a card of 8 GiB."""

    def __init__(
        self,
        driver: CoreDriver | None = None,
        steady: int = 5 * GIB,
        stay_s: float = 0.0,
        **child: Any,
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


def revokes(effects: list[Any]) -> list[tuple[str, int, int]]:
    pushed = [e.body for e in effects if isinstance(e, Push) and e.body["push"] == "revoke"]
    return [(p["lease_id"], p["uses"], p.get("children", 0)) for p in pushed]
