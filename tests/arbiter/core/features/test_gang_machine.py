"""A rule machine over gangs: yields, gangs and circles in any order, with deaths and restarts in
between.

Holders that load only what they were granted never overfill the GPU, every waiter is served in the
end, and nothing stays charged when all processes are gone.
"""

from typing import Any

import hypothesis.strategies as st
from hypothesis.stateful import Bundle, RuleBasedStateMachine, initialize, invariant, multiple, rule

from tests.support.core_driver import Consumer, CoreDriver, as_wire
from tests.support.machines import walk
from vram_arbiter.arbiter.core.effects import Effect, Refuse, Reply
from vram_arbiter.arbiter.core.features import gangs as features_gangs
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey

CAPACITY = 8 * d.GIB
MOMENT_S = 0.0001
SIZES = [450 * d.MIB, 1 * d.GIB, 2 * d.GIB, 3_300_000_000, 4_300_000_000, 5_300_000_000, 7 * d.GIB]


class Gangs(RuleBasedStateMachine):
    """Model: what each process has put on the GPU."""

    leases = Bundle("leases")

    @initialize(lag=st.sampled_from([0.0, 0.03, 0.8]), lists=st.booleans())
    def start(self, lag: float, lists: bool) -> None:
        self.driver = CoreDriver(CAPACITY, start=False)
        self.driver.device.lag_s = lag
        self.driver.device.lists_processes = lists
        self.driver.advance(0.01)  # the first reading
        self.people = [self.driver.consumer(f"p{n}") for n in range(5)]
        self.mine: dict[LeaseId, Consumer] = {}
        self.loaded: dict[ProcessKey, dict[LeaseId, int]] = {}
        self.context: dict[ProcessKey, int] = {}
        self.gangs = 0
        self.dead: list[Consumer] = []

    # -- asking
    def ask(self, who: Consumer, size: int, steady: int, spec: dict[str, Any]) -> Any:
        if (
            sum(
                self.driver.state(lease) != "over"
                for lease, owner in self.mine.items()
                if owner is who
            )
            > 2
        ):
            return None
        spec = dict(spec)
        wait_timeout_s = spec.pop("wait_timeout_s", None)
        effects = who.try_acquire(size, steady, wait_timeout_s=wait_timeout_s, **spec)
        reply = next((effect for effect in effects if isinstance(effect, Reply)), None)
        if reply is None:
            assert any(isinstance(effect, Refuse) for effect in effects)
            return None
        lease = LeaseId(as_wire(reply.body)["lease"]["lease_id"])
        who.specs[lease] = who.spec(size, steady, **spec)
        self.mine[lease] = who
        return lease

    @rule(
        target=leases,
        who=st.integers(0, 4),
        size=st.sampled_from(SIZES),
        shrink=st.booleans(),
        spec=st.fixed_dictionaries(
            {
                "exclusive": st.sampled_from([False, False, False, True]),
                "priority": st.sampled_from([40, 50, 60]),
                "residue_bytes": st.sampled_from([0, 450 * d.MIB]),
                "independent": st.booleans(),
            }
        ),
    )
    def acquire(self, who: int, size: int, shrink: bool, spec: dict[str, Any]) -> Any:
        steady = max(size // 2, spec["residue_bytes"]) if shrink else size
        lease = self.ask(self.people[who], size, steady, spec)
        return multiple() if lease is None else lease

    @rule(
        target=leases,
        sizes=st.lists(st.sampled_from(SIZES[:5]), min_size=2, max_size=3),
        missing=st.booleans(),
    )
    def gang(self, sizes: list[int], missing: bool) -> Any:
        self.gangs += 1
        name = (f"g{self.gangs}", len(sizes))
        asked = sizes[:-1] if missing else sizes
        made = [
            self.ask(
                self.people[n], size, max(size // 2, 1), {"gang": name, "wait_timeout_s": 40.0}
            )
            for n, size in enumerate(asked)
        ]
        return multiple(*(lease for lease in made if lease is not None))

    # -- holding
    @rule(lease=leases)
    def load(self, lease: LeaseId) -> None:
        """To its peak and down again. It takes time: a reading that began before it cannot have
        seen it."""
        if self.driver.state(lease) != "loading":
            return
        self.driver.advance(MOMENT_S)
        who = self.mine[lease]
        spec = who.specs[lease]
        held = self.loaded.setdefault(who.process, {})
        self.context[who.process] = max(
            self.context.get(who.process, 0), spec.footprint.residue_bytes
        )
        held[lease] = max(spec.footprint.load_peak_bytes, spec.footprint.residue_bytes)
        self.show(who.process)
        self.fits()
        self.driver.advance(MOMENT_S)
        held[lease] = max(spec.footprint.steady_bytes, spec.footprint.residue_bytes)
        self.show(who.process)
        assert self.driver.state(lease) == "loading"
        who.ready(lease)

    def show(self, process: ProcessKey) -> None:
        count = max(sum(self.loaded.get(process, {}).values()), self.context.get(process, 0))
        self.driver.device.set(process, count, self.driver.now)

    def fits(self) -> None:
        shown = self.driver.device.shown(self.driver.now)
        assert sum(shown.values()) <= CAPACITY, (shown, self.driver.status())

    @rule(lease=leases, who=st.integers(0, 4))
    def use(self, lease: LeaseId, who: int) -> None:
        if self.driver.state(lease) == "held":
            self.people[who].use_begin(lease, f"u{who}", self.mine[lease].token(lease))

    @rule(lease=leases, who=st.integers(0, 4))
    def pause(self, lease: LeaseId, who: int) -> None:
        if self.driver.state(lease) in ("held", "revoking"):
            self.people[who].use_yield(lease, f"u{who}", self.mine[lease].token(lease))

    @rule(lease=leases)
    def end_uses(self, lease: LeaseId) -> None:
        if self.driver.state(lease) in ("held", "revoking"):
            for n, person in enumerate(self.people):
                person.use_end(lease, f"u{n}", self.mine[lease].token(lease))

    # -- leaving
    def unload(self, lease: LeaseId) -> None:
        who = self.mine[lease]
        began = who.unloading(lease)
        if any(isinstance(effect, Refuse) for effect in began):
            return  # in use
        self.loaded.get(who.process, {}).pop(lease, None)
        self.show(who.process)
        who.release(lease)

    @rule(lease=leases)
    def comply(self, lease: LeaseId) -> None:
        view = self.driver.view(lease)
        if view is not None and view["state"] == "revoking":
            self.mine[lease].ack(lease)
            self.unload(lease)

    @rule(lease=leases)
    def give_back(self, lease: LeaseId) -> None:
        view = self.driver.view(lease)
        if view is None or view["state"] != "held" or view["uses"]:
            return
        self.unload(lease)

    @rule(lease=leases)
    def fail_to_load(self, lease: LeaseId) -> None:
        if self.driver.state(lease) == "loading":
            self.mine[lease].release(lease)

    @rule(lease=leases)
    def cancel(self, lease: LeaseId) -> None:
        if self.driver.state(lease) == "queued":
            self.mine[lease].cancel(lease)

    @rule(who=st.integers(0, 4))
    def die(self, who: int) -> None:
        person = self.people[who]
        self.loaded.pop(person.process, None)
        self.context.pop(person.process, None)
        person.die()
        self.dead.append(person)
        self.people[who] = self.driver.consumer(f"p{who}")

    # -- the world
    @rule(seconds=st.sampled_from([0.002, 0.02, 0.3, 2.0, 35.0]))
    def wait(self, seconds: float) -> None:
        self.driver.advance(seconds)

    @rule()
    def restart(self) -> None:
        held = {
            lease: (view["state"], person.token(lease))
            for lease, person in self.mine.items()
            if (view := self.driver.view(lease)) is not None
            and view["state"] in ("loading", "held", "revoking", "unloading")
        }
        total = self.driver.gpu()["charged_bytes"]
        self.driver.restart(epoch=self.driver.settings.epoch + 1)
        for (
            person
        ) in self.dead:  # a daemon that starts looks for the processes of its journal first
            person.die()
        for person in self.people:
            person.connect()
        for lease, (state, token) in held.items():
            effects: list[Effect] = self.mine[lease].reattach(lease, token, held=state != "loading")
            if any(
                as_wire(effect.body)["leases"][0]["kept"] is False
                for effect in effects
                if isinstance(effect, Reply)
            ):
                self.loaded.get(self.mine[lease].process, {}).pop(
                    lease, None
                )  # it was told so, and unloads
                self.show(self.mine[lease].process)
        assert self.driver.gpu()["charged_bytes"] <= total, "nothing is granted twice"

    @invariant()
    def nothing_is_overfilled(self) -> None:
        if hasattr(self, "driver"):
            self.fits()

    def teardown(self) -> None:
        """Everybody cooperates: whoever waits is served, and once all have died nothing is
        charged."""
        if not hasattr(self, "driver"):
            return
        waiting: set[LeaseId] = set()
        for turn in range(300):
            if turn in range(
                100, 150, 10
            ):  # contexts of live processes may be all that is in the way
                self.die((turn - 100) // 10)
            for lease in self.mine:
                self.load(lease)
                self.end_uses(lease)
                self.comply(lease)
            waiting = {lease for lease in self.mine if self.driver.state(lease) == "queued"}
            if not waiting:
                break
            self.driver.advance(0.5)
        assert not waiting, self.driver.status()
        for n in range(5):
            self.die(n)
        self.driver.advance(15.0)
        assert self.driver.gpu()["charged_bytes"] == 0, self.driver.status()
        core = self.driver.arbiter.inspect()
        assert not core.users
        gangs = core.feature(features_gangs.Gangs)
        assert not gangs.by_name
        assert not core.unqueued
        assert not any(gpu.keeper or gpu.ledger.reserved for gpu in core.gpus.values())


TestGangs = Gangs.TestCase
TestGangs.settings = walk(80)
