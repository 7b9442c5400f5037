"""Shares of the server: requests by connection and process, sessions by process and user. Pure:
time is passed in.

A request is charged by its size, because its cost grows with it. Processor time of different users
is not divided here but by the router, which handles messages in turns over users and processes: a
budget of a user would let some of its processes refuse another.
"""

from dataclasses import dataclass

from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime.zmtp import Oversize

CHARGE_BYTES = 1024
"""A request costs one, and one more for each of these many bytes."""
SKIPPED_CHARGE_BYTES = 64 * 1024
"""The same for a message over its limit, which was skipped without being kept or decoded."""
PROCESSES_MAX = 1024
"""Budgets kept before those that have refilled are forgotten."""


@dataclass(slots=True)
class Budget:
    """What may still be spent at once; it refills within one second."""

    rate: float
    left: float
    at: float

    def has_some(self, now: float) -> bool:
        self.left = min(self.rate, self.left + (now - self.at) * self.rate)
        self.at = now
        return self.left >= 1


class ProcessBudgets:
    """One budget for all connections of a process. It outlives them: connecting again does not
    refill it."""

    def __init__(self, rate: float) -> None:
        self._rate = rate
        self._budgets: dict[tuple[int, ProcessKey], Budget] = {}

    def of(self, uid: int, process: ProcessKey, now: float) -> Budget:
        key = (uid, process)  # a process that cannot be seen has pid 0, whichever it is
        if (found := self._budgets.get(key)) is not None:
            return found
        if len(self._budgets) >= PROCESSES_MAX:
            self._forget_refilled(now)
        made = self._budgets[key] = Budget(self._rate, self._rate, now)
        return made

    def _forget_refilled(self, now: float) -> None:
        for key, budget in list(self._budgets.items()):
            if budget.left + (now - budget.at) * budget.rate >= budget.rate:
                del self._budgets[key]


class WatchedProcesses:
    """Processes that are watched since a hello: each costs a descriptor until it dies, with or
    without a connection."""

    def __init__(self, most: int, user_share: float) -> None:
        self.most = most
        self.most_of_user = share_of(most, user_share)
        self._users: dict[ProcessKey, int] = {}
        self._counts: dict[int, int] = {}

    def __len__(self) -> int:
        return len(self._users)

    def of_user(self, uid: int) -> int:
        return self._counts.get(uid, 0)

    def add(self, process: ProcessKey, uid: int) -> None:
        self._users[process] = uid
        self._counts[uid] = self.of_user(uid) + 1

    def discard(self, process: ProcessKey) -> None:
        uid = self._users.pop(process, None)
        if uid is not None:
            self._counts[uid] -= 1
            if not self._counts[uid]:
                del self._counts[uid]

    def __contains__(self, process: ProcessKey) -> bool:
        return process in self._users


def spend(cost: int, own: Budget, process: Budget, now: float) -> bool:
    """Charge a request to a connection and its process. False: one of them has nothing left, and
    nothing is charged.

    A request that costs more than what is left goes through, and the next ones wait until that is
    paid.
    """
    if not (own.has_some(now) and process.has_some(now)):
        return False
    own.left -= cost
    process.left -= cost
    return True


def cost_of(payload: bytes | bytearray | Oversize) -> int:
    if isinstance(payload, Oversize):
        return 1 + payload.size // SKIPPED_CHARGE_BYTES
    return 1 + len(payload) // CHARGE_BYTES


def share_of(total: int, share: float) -> int:
    """Places of one process or user; at least one."""
    return max(1, int(total * share))
