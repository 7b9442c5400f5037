"""Scenes that several files of the core's tests begin with: a resident holder, a detector that was
sent away, a tree of leases."""

from typing import Any, Literal

from tests.support.core_driver import Consumer, CoreDriver
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import LeaseId


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


def in_use(driver: CoreDriver, name: str, gib: float, **spec: Any) -> tuple[Consumer, LeaseId]:
    """A holder in the middle of its own use, and its lease."""
    person, lease = held(driver, name, gib, **spec)
    person.use_begin(lease)
    return person, lease


def give_back(driver: CoreDriver, person: Consumer, lease: LeaseId) -> None:
    """Unload at a safe point, until the bytes are measured gone."""
    person.unload(lease)
    driver.until(lambda: driver.state(lease) == "over")


def hidden_gpu(*, lists: bool = True, lag_s: float = 0.0) -> CoreDriver:
    """A GPU of 8 GiB as it is from the first reading on: with or without a list of processes, late
    by so much."""
    driver = CoreDriver(8 * GIB, start=False)
    driver.device.lists_processes = lists
    driver.device.lag_s = lag_s
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
    """The GPU that it is on."""
    gpu: str | None = shown(driver, lease)["gpu"]
    return gpu


def verdicts(driver: CoreDriver) -> list[tuple[str, bool]]:
    """Return the verdicts so far, each with whether it freed the charge."""
    return [(note["verdict"], note["resolved"]) for note in driver.notes("verified")]


def why(driver: CoreDriver, consumer: str) -> dict[str, Any]:
    """What `why` says of a consumer with one lease."""
    found: dict[str, Any]
    (found,) = driver.why(consumer)["leases"]
    return found


def revoked(
    driver: CoreDriver, gib: float = 5, policy_gib: float = 5, **spec: Any
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """A detector that comes back from standby, revoked, and the policy that waits for its room."""
    det, lease = held(driver, "det", gib, standby=True, **spec)
    policy = driver.consumer("policy")
    wanted = policy.acquire(int(policy_gib * GIB))
    driver.until(lambda: driver.state(lease) == "revoking")
    return det, lease, policy, wanted


def sent_away(
    driver: CoreDriver, gib: float = 5, policy_gib: float = 5, **spec: Any
) -> tuple[Consumer, LeaseId, Consumer, LeaseId]:
    """A detector on standby, and the policy that it left for, resident."""
    det, lease, policy, wanted = revoked(driver, gib, policy_gib, **spec)
    det.unload(lease)
    driver.until(lambda: driver.state(wanted) == "loading")
    assert driver.state(lease) == "standby"
    policy.load(wanted)
    driver.advance(0.01)
    return det, lease, policy, wanted


def order(driver: CoreDriver, action: Literal["evict", "pin"], lease: LeaseId) -> None:
    """An operator does this to a lease."""
    ops = driver.consumer("ops")
    ops.order(action, lease)
