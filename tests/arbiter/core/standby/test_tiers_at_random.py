"""Random lives of leases that stand by, park, grow, shrink and are sent away, over restarts: bytes,
host RAM and turns stay right."""

import collections
import random

import pytest

from tests.support.core_driver import Consumer, CoreDriver, answer, refusal
from tests.support.full_check import check_arbiter
from vram_arbiter.arbiter.core.effects import Note, Refuse
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

GIB, MIB = d.GIB, d.MIB
CAPACITY = 8 * GIB
STRANGER = ProcessKey(9, 9)
BUDGET = CAPACITY - d.RESERVE_BYTES


class Crowd:
    """Four processes with one lease each at a time, and what each holds on its GPU by its own
    doing."""

    def __init__(self, seed: int) -> None:
        self.draw = random.Random(seed)
        settings = {"host_ram_budget_bytes": 6 * GIB, "thrash_hold_max_s": 3.0}
        self.driver = CoreDriver(CAPACITY, gpus=self.draw.choice([1, 2, 3]), settings=settings)
        for device in self.driver.devices.values():
            device.lag_s = self.draw.choice([0.0, 0.1])
        self.people = [self.driver.consumer(f"p{n}") for n in range(4)]
        self.leases: dict[LeaseId, Consumer] = {}

    def mine(self, person: Consumer) -> LeaseId | None:
        found = [
            x
            for x, owner in self.leases.items()
            if owner is person and self.driver.state(x) != "over"
        ]
        return found[0] if found else None

    def acquire(self, person: Consumer) -> None:
        size = self.draw.choice([1, 2, 3, 5, 7]) * GIB
        spec = {
            "gpu": self.draw.choice(["any", "any", "0"]),
            "standby": self.draw.random() < 0.6,
            "park_bytes": self.draw.choice([0, size]),
            "priority": self.draw.choice([40, 50, 60]),
            "min_residency_s": self.draw.choice([0.0, 0.5]),
            "residue_bytes": self.draw.choice([0, 100 * MIB]),
        }
        effects = person.try_acquire(size, **spec)
        if any(isinstance(effect, Refuse) for effect in effects):
            refused = refusal(effects)
            assert (refused.code, bool(refused.details["pinned"])) == ("vram_insufficient", True)
            return
        lease = LeaseId(answer(effects)["lease"]["lease_id"])
        person.specs[lease] = person.spec(size, **spec)
        self.leases[lease] = person

    def step(self, person: Consumer) -> None:
        lease = self.mine(person)
        if lease is None:
            self.acquire(person)
            return
        view = self.driver.view(lease)
        assert view is not None
        chance = self.draw.random()
        match view["state"]:
            case "loading" if (
                chance < 0.2
            ):  # killed or asked here, it has a part of its bytes already
                person.hold(person.specs[lease].footprint.steady_bytes // 2, gpu=view["gpu"])
            case "loading":
                person.load(lease)
            case "held" if view["uses"]:
                person.use_end(lease)
            case "held" if chance < 0.4:
                person.use_begin(lease)
            case "held" if chance < 0.6:
                person.unload(lease, parked=False)
            case "revoking" if view["uses"]:
                person.use_end(lease)
            case "revoking":
                person.unload(lease, parked="parked_bytes" in view)
            case "standby" | "parked" if chance < 0.3:
                person.reacquire(lease)
            case "standby" | "parked" if chance < 0.4:
                self.acquire(person)
            case "standby" | "parked" | "queued" if chance < 0.45:
                person.cancel(lease)
            case _:
                pass

    def disturb(self) -> None:
        chance = self.draw.random()
        if chance < 0.03:
            self.restart()
        elif chance < 0.06:
            number = self.draw.randrange(len(self.people))
            self.people[number].die()
            self.people[number] = self.driver.consumer(f"p{number}")
        elif chance < 0.08:
            lease = self.mine(self.draw.choice(self.people))
            if lease is not None:
                self.order(lease, "evict")
        elif chance < 0.1:
            device = self.draw.choice(list(self.driver.devices.values()))
            device.failing = "" if device.failing else "probe died"
        elif chance < 0.12:  # somebody without a lease comes, goes, or gives back a part
            device = self.draw.choice(list(self.driver.devices.values()))
            device.set(STRANGER, self.draw.choice([0, GIB, 3 * GIB]), self.driver.now)
        elif chance < 0.14:
            lease = self.mine(self.draw.choice(self.people))
            if lease is not None:
                self.order(lease, self.draw.choice(["pin", "unpin"]))

    def order(self, lease: LeaseId, action: str) -> None:
        ops = self.driver.consumer("ops")
        ops.order(action, lease)

    def restart(self) -> None:
        known = {lease: (self.driver.view(lease), owner) for lease, owner in self.leases.items()}
        tokens = {
            lease: owner.token(lease)
            for lease, (view, owner) in known.items()
            if view is not None and view["token"] is not None
        }
        self.driver.restart(epoch=self.driver.settings.epoch + 1)
        for person in self.people:
            person.connect()
        for lease, token in tokens.items():
            view, owner = known[lease]
            if view is None or owner not in self.people:
                continue
            state = view["state"]
            away = state in ("standby", "parked", "queued")
            parked = "parked_bytes" in view and state != "held"
            if state != "verifying":
                uses = ["u1"] if view["uses"] else []
                owner.reattach(
                    lease,
                    token,
                    held=state != "loading",
                    away=away,
                    parked=away and parked,
                    uses=uses,
                )

    def check(self) -> None:
        check_arbiter(self.driver.arbiter)
        for device in self.driver.devices.values():
            shown = device.shown(self.driver.now)
            assert sum(count for process, count in shown.items() if process != STRANGER) <= BUDGET
        status = self.driver.status()
        assert status["host_ram"]["parked_bytes"] == sum(
            v.get("parked_bytes", 0) for v in status["leases"]
        )


def live_at_random(seed: int, steps: int) -> tuple[Crowd, collections.Counter[str]]:
    crowd = Crowd(seed)
    for _ in range(steps):
        crowd.disturb()
        crowd.step(crowd.draw.choice(crowd.people))
        crowd.driver.advance(crowd.draw.choice([0.01, 0.1, 0.6, 3.0]))
        crowd.check()
    for device in crowd.driver.devices.values():
        device.failing = ""
        device.set(STRANGER, 0, crowd.driver.now)
    for lease in crowd.leases:
        if crowd.driver.state(lease) != "over":
            crowd.order(lease, "unpin")
    for _ in range(600):
        waiting = [x for x in crowd.leases if crowd.driver.state(x) == "queued"]
        if not waiting:
            break
        for person in crowd.people:
            lease = crowd.mine(person)
            state = None if lease is None else crowd.driver.state(lease)
            if state in ("loading", "revoking") or (
                state == "held" and crowd.driver.view(lease)["uses"]
            ):  # type: ignore[arg-type,index]
                crowd.step(person)
        crowd.driver.advance(0.3)
    assert not [x for x in crowd.leases if crowd.driver.state(x) == "queued"], crowd.driver.status()
    kinds = collections.Counter(e.kind for e in crowd.driver.effects if isinstance(e, Note))
    return crowd, kinds


@pytest.mark.parametrize("block", range(4))
def test_nothing_is_lost_or_granted_twice(block: int) -> None:
    seen: collections.Counter[str] = collections.Counter()
    for seed in range(block * 3, block * 3 + 3):
        seen += live_at_random(seed, 120)[1]
    assert all(seen[kind] for kind in ("standby", "parked", "granted", "revoke_asked")), seen
