"""A rule machine drives the core against the physical card: whatever happens in whatever order, as long as holders load only what
they were granted and leave when asked, the card never overflows, tokens grow, and everybody is served in the end."""

from typing import Any

import hypothesis.strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, consumes, initialize, invariant, multiple, rule

from arbiter.core import policy
from arbiter.core.effects import Push, Reply
from arbiter.testing.core_driver import Consumer, CoreDriver
from arbiter.testing.machines import walk
from schemas import defaults as d
from schemas.ids import LeaseId, ProcessKey

CAPACITY = 8 * d.GIB
SIZES = [450 * d.MIB, 1 * d.GIB, 2 * d.GIB, 3_300_000_000, 4_300_000_000, 5_300_000_000, 7 * d.GIB]
STRANGER = ProcessKey(9, 9)


class Leases(RuleBasedStateMachine):
    """Model: what each process holds on the card by its own doing; `known` are its leases as it knows them."""

    leases = Bundle("leases")

    @initialize(lag=st.sampled_from([0.0, 0.03, 0.8]), lists=st.booleans())
    def start(self, lag: float, lists: bool) -> None:
        self.driver = CoreDriver(CAPACITY, settings={"host_ram_budget_bytes": 3 * d.GIB})
        self.driver.card.lag_s = lag
        self.driver.card.lists_processes = lists
        self.people = [self.driver.consumer(f"p{n}") for n in range(4)]
        self.mine: dict[LeaseId, Consumer] = {}
        self.loaded: dict[ProcessKey, dict[LeaseId, int]] = {}  # what each process holds for which lease
        self.context: dict[ProcessKey, int] = {}  # what it keeps once it has loaded anything

    # -- what people do --------------------------------------------------------------------------------------------
    @rule(
        target=leases,
        who=st.integers(0, 3),
        size=st.sampled_from(SIZES),
        shrink=st.booleans(),
        spec=st.fixed_dictionaries(
            {
                "exclusive": st.sampled_from([False, False, True]),
                "priority": st.sampled_from([40, 50, 50, 60]),
                "evictable": st.sampled_from([True, True, True, False]),
                "residue_bytes": st.sampled_from([0, 450 * d.MIB]),
                "min_residency_s": st.sampled_from([0.0, 0.5]),
                "standby": st.sampled_from([False, False, True]),
                "park_bytes": st.sampled_from([0, 0, 2 * d.GIB]),
            }
        ),
    )
    def acquire(self, who: int, size: int, shrink: bool, spec: dict[str, Any]) -> Any:
        person = self.people[who]
        if (
            sum(self.driver.state(lease) != "over" for lease, owner in self.mine.items() if owner is person)
            > 1
        ):
            return multiple()  # at most two leases a process
        steady = max(size // 2, spec["residue_bytes"]) if shrink else size
        effects = person.try_acquire(size, steady, **spec)
        reply = next((effect for effect in effects if isinstance(effect, Reply)), None)
        if reply is None:  # beside a pinned lease it can never fit
            return multiple()
        lease = LeaseId(reply.body["lease"]["lease_id"])
        person.specs[lease] = person.spec(size, steady, **spec)
        self.mine[lease] = person
        return lease

    @rule(lease=leases)
    def load(self, lease: LeaseId) -> None:
        if self.driver.state(lease) == "loading":
            spec = self.mine[lease].specs[lease]
            process = self.mine[lease].process
            self.loaded.setdefault(process, {})[lease] = max(spec.steady_bytes, spec.residue_bytes)
            self.context[process] = max(self.context.get(process, 0), spec.residue_bytes)
            self.show(process)
            self.mine[lease].ready(lease)

    def show(self, process: ProcessKey) -> None:
        """Put on the card what the process holds."""
        count = max(sum(self.loaded[process].values()), self.context[process])
        self.driver.card.set(process, count, self.driver.now)

    def unload(self, lease: LeaseId) -> None:
        person = self.mine[lease]
        person.unloading(lease)
        del self.loaded[person.process][lease]
        self.show(person.process)
        view = self.driver.view(lease)
        person.release(lease, parked=view is not None and "parked_bytes" in view)

    @rule(lease=leases, who=st.integers(0, 3))
    def use(self, lease: LeaseId, who: int) -> None:
        if self.driver.state(lease) == "held":
            self.people[who].use_begin(lease, f"u{who}", self.mine[lease].token(lease))

    @rule(lease=leases)
    def end_uses(self, lease: LeaseId) -> None:
        if self.driver.state(lease) in ("held", "revoking"):
            for n, person in enumerate(self.people):
                person.use_end(lease, f"u{n}", self.mine[lease].token(lease))

    @rule(lease=leases)
    def comply(self, lease: LeaseId) -> None:
        view = self.driver.view(lease)
        if view is not None and view["state"] == "revoking":
            self.mine[lease].ack(lease)
            if not view["uses"]:
                self.unload(lease)

    @rule(lease=leases)
    def give_back(self, lease: LeaseId) -> None:
        view = self.driver.view(lease)
        if view is not None and view["state"] == "held" and not view["uses"]:
            self.unload(lease)

    @rule(lease=leases)
    def want_back(self, lease: LeaseId) -> None:
        if self.driver.state(lease) in ("standby", "parked", "verifying"):
            self.mine[lease].reacquire(lease)

    @rule(lease=leases, less=st.sampled_from([0, 100 * d.MIB, 1 * d.GIB]))
    def shrink(self, lease: LeaseId, less: int) -> None:
        if self.driver.state(lease) == "held":
            person = self.mine[lease]
            spec = person.specs[lease]
            size = max(self.loaded[person.process][lease] - less, spec.residue_bytes)
            self.loaded[person.process][lease] = size
            self.show(person.process)
            person.resize(lease, size, residue_bytes=spec.residue_bytes)

    @rule(lease=leases, more=st.sampled_from([100 * d.MIB, 1 * d.GIB]))
    def grow(self, lease: LeaseId, more: int) -> None:
        """Asks only: what it was granted it may use, and need not."""
        if self.driver.state(lease) == "held":
            person = self.mine[lease]
            size = self.loaded[person.process][lease] + more
            person.resize(lease, size, residue_bytes=person.specs[lease].residue_bytes)

    @rule(lease=leases)
    def fail_to_load(self, lease: LeaseId) -> None:
        if self.driver.state(lease) == "loading":
            self.mine[lease].release(lease)

    @rule(lease=consumes(leases))
    def cancel(self, lease: LeaseId) -> Any:
        if self.driver.state(lease) == "queued":
            self.mine[lease].cancel(lease)

    @rule(who=st.integers(0, 3))
    def die(self, who: int) -> None:
        self.people[who].die()
        self.people[who] = self.driver.consumer(f"p{who}")

    # -- what the world does -----------------------------------------------------------------------------------------
    @rule(seconds=st.sampled_from([0.002, 0.02, 0.3, 2.0, 35.0]))
    def wait(self, seconds: float) -> None:
        self.driver.advance(seconds)

    @rule(count=st.sampled_from([0, 100 * d.MIB, 250 * d.MIB]))
    def stranger(self, count: int) -> None:
        self.driver.card.set(STRANGER, count, self.driver.now)

    @rule(failing=st.sampled_from(["", "", "probe died"]))
    def probe(self, failing: str) -> None:
        self.driver.card.failing = failing

    @rule()
    def restart(self) -> None:
        """kill -9 of the daemon: the journal survives, holders come back with their tokens, waiters have to ask again."""
        held = {
            lease: (view["state"], person.token(lease), view["uses"])
            for lease, person in self.mine.items()
            if (view := self.driver.view(lease)) is not None
            and view["state"] in ("loading", "held", "revoking", "unloading")
        }
        away = {
            lease: (view["state"], person.token(lease))
            for lease, person in self.mine.items()
            if (view := self.driver.view(lease)) is not None and view["state"] in ("standby", "parked")
        }
        self.driver.restart(epoch=self.driver.settings.epoch + 1)
        for person in self.people:
            person.connect()
        for lease, (state, token, _) in held.items():
            self.mine[lease].reattach(lease, token, held=state != "loading")
        for lease, (state, token) in away.items():
            self.mine[lease].reattach(lease, token, away=True, parked=state == "parked")

    # -- what must hold ------------------------------------------------------------------------------------------------
    @invariant()
    def card_never_overflows(self) -> None:
        if not hasattr(self, "driver"):
            return
        shown = self.driver.card.shown(self.driver.now)
        coming = 0
        for view in self.driver.arbiter.status(self.driver.now)["leases"]:
            if view["state"] == "loading":
                person = self.mine[view["lease_id"]]
                peak = person.specs[view["lease_id"]].load_peak_bytes
                if self.loaded.get(person.process):
                    coming += peak
                else:  # its context is part of the peak
                    coming += max(0, peak - self.driver.card.held.get(person.process, 0))
        assert sum(shown.values()) + coming <= CAPACITY

    @invariant()
    def tokens_grow(self) -> None:
        if not hasattr(self, "driver"):
            return
        tokens = [
            effect.body["lease"]["token"]
            for effect in self.driver.effects
            if isinstance(effect, Reply | Push) and effect.body.get("lease", {}).get("state") == "loading"
        ]
        assert tokens == sorted(tokens)
        assert len({tuple(token) for token in tokens}) == len(tokens)

    @invariant()
    def no_lost_wake_up(self) -> None:
        """Whenever readings are in and nothing blocks, the head does not fit (else it would have been granted)."""
        if not hasattr(self, "driver"):
            return
        core = self.driver.arbiter._core
        gpu = next(iter(core.gpus.values()))
        head = gpu.queue.head()
        if head is None or policy.blocked(core, gpu) or gpu.asked_at is not None:
            return
        room = policy.measured_room_bytes(core, gpu)
        assert not (
            policy.fits(gpu, head) and room is not None and room >= policy.measured_need_bytes(gpu, head)
        )

    def teardown(self) -> None:
        """Everybody cooperates: uses end, who is asked leaves, pinned ones go home. Then every waiter is served (or its process
        is one of those that have to exit)."""
        if not hasattr(self, "driver"):
            return
        self.driver.card.failing = ""
        self.driver.card.set(STRANGER, 0, self.driver.now)
        waiting: set[LeaseId] = set()
        for turn in range(400):
            if turn in (
                100,
                110,
                120,
                130,
            ):  # residues of live processes may be all that is in the way: exit, one by one
                self.die((turn - 100) // 10)
            for lease in self.mine:
                self.load(lease)
                self.end_uses(lease)
                self.comply(lease)
                view = self.driver.view(lease)
                if view is not None and view["state"] == "held" and not view["evictable"]:
                    self.unload(lease)
            waiting = {lease for lease in self.mine if self.driver.state(lease) == "queued"}
            if not waiting:
                break
            self.driver.advance(0.5)
        assert not waiting, self.driver.arbiter.status(self.driver.now)


TestLeases = Leases.TestCase
TestLeases.settings = walk(60)
