"""A rule machine drives the core against the physical GPU and a small ledger of its own: whatever
happens in whatever order, as long as holders load only what they were granted and leave when asked,
the GPU never overflows, every byte that somebody holds is charged, tokens grow, no wake-up is
lost, and everybody is served in the end, within a bound, however many arrive after him.

What has to hold is looked at after every event, not only after every rule. Rules are enabled only
where they do something, and breakdowns only now and then: a history that restarts the daemon all
the time grants nothing. Every history begins with some who hold or wait, for Hypothesis leaves out
some rules in each.
"""

from collections.abc import Callable
from typing import Any

import hypothesis.strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, precondition, rule

from tests.support.core_driver import Consumer, CoreDriver, answer, as_wire
from tests.support.engine_state import state_of
from tests.support.machines import walk
from vram_arbiter.arbiter.core.effects import Push, Reply
from vram_arbiter.arbiter.core.events import SettingsChanged
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.scheduling import admission
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.ids import LeaseId, ProcessKey
from vram_arbiter.schemas.wire.pushes import RevokePush, RevokeWithdrawnPush

CAPACITY = 8 * d.GIB
SIZES = [450 * d.MIB, 1 * d.GIB, 2 * d.GIB, 3_300_000_000, 4_300_000_000, 5_300_000_000, 7 * d.GIB]
PRIORITIES = [40, 50, 50, 60]
STRANGER = ProcessKey(9, 9)
PEOPLE = 4
LEASES_MAX = 2  # of a process
LOAD_MAX_S = 5.0
CALM_EVENTS = 40  # between two breakdowns of a kind

QUEUED, LOADING, HELD, REVOKING = (
    LeaseState.QUEUED,
    LeaseState.LOADING,
    LeaseState.HELD,
    LeaseState.REVOKING,
)
AWAY = (LeaseState.STANDBY, LeaseState.PARKED)

TURN_S = 0.5
EXITS = range(
    100, 100 + 10 * PEOPLE, 10
)  # turns in which a process exits: its context may be in the way
AGEING_S = (max(PRIORITIES) - min(PRIORITIES)) * d.AGEING_S_PER_POINT
WAIT_MAX_S = AGEING_S + 100.0
"""Who waits has aged past every newcomer after `AGEING_S`; the rest serves those ahead of him, one
after the other."""
NEWCOMERS = 3  # who wait or hold at a time, as long as somebody waits who was there before them

type Wish = tuple[int, bool, float | None, dict[str, Any]]
WISHES = st.tuples(
    st.sampled_from(SIZES),
    st.booleans(),  # less after the load than during it
    st.sampled_from([None, None, 1.0, 20.0]),  # how long it can wait
    st.fixed_dictionaries(
        {
            "exclusive": st.sampled_from([False, False, True]),
            "priority": st.sampled_from(PRIORITIES),
            "evictable": st.sampled_from([True, True, True, False]),
            "residue_bytes": st.sampled_from([0, 450 * d.MIB]),
            "min_residency_s": st.sampled_from([0.0, 0.5]),
            "standby": st.sampled_from([False, False, True]),
            "park_bytes": st.sampled_from([0, 0, 2 * d.GIB]),
        }
    ),
)
PICK = st.integers(0, 7)  # which of those that a rule could be about


def some(*states: LeaseState) -> Callable[["Leases"], bool]:
    """A rule about leases in these states."""
    return lambda machine: bool(machine.having(*states))


class Leases(RuleBasedStateMachine):
    """Model: what each process holds on the GPU by its own doing; `mine` are the leases as their
    processes know them."""

    @initialize(
        lag=st.sampled_from([0.0, 0.03, 0.8]),
        lists=st.booleans(),
        crowd=st.booleans(),
        wishes=st.lists(WISHES, min_size=1, max_size=PEOPLE),
    )
    def start(self, lag: float, lists: bool, crowd: bool, wishes: list[Wish]) -> None:
        self.driver = CoreDriver(CAPACITY, settings={"host_ram_budget_bytes": 3 * d.GIB})
        self.driver.device.lag_s = lag
        self.driver.device.lists_processes = lists
        self.crowd = crowd  # newcomers keep arriving while the last waiters are served
        self.people = [self.driver.consumer(f"p{n}") for n in range(PEOPLE)]
        self.mine: dict[LeaseId, Consumer] = {}
        self.loaded: dict[
            ProcessKey, dict[LeaseId, int]
        ] = {}  # what each process holds for which lease
        self.context: dict[ProcessKey, int] = {}  # what it keeps once it has loaded anything
        self.taking_over: dict[
            LeaseId, int
        ] = {}  # away, and perhaps taken over by the request of this event: its peak then
        self.bounds: dict[LeaseId, float] = {}  # who may wait until when
        self.broke: dict[str, int] = {}  # events until the last breakdown of a kind
        self.tokens: list[Any] = []
        self.stays: set[LeaseId] = set()  # revoked, and told to stay since
        self.seen = 0  # effects that were looked at
        self.driver.after_event = self.sound
        for n, wish in enumerate(wishes):
            self.acquire(n, wish)
            self.driver.advance(0.01)
            self.everybody_goes_on()

    def having(self, *states: LeaseState) -> list[LeaseId]:
        leases = self.driver.arbiter.inspect().leases
        return [lease for lease in self.mine if lease in leases and leases[lease].state in states]

    def lease(self, lease: LeaseId) -> Lease:
        return self.driver.arbiter.inspect().leases[lease]

    def pick(self, n: int, *states: LeaseState) -> LeaseId:
        found = self.having(*states)
        return found[n % len(found)]

    def asking(self) -> list[Consumer]:
        live = [self.mine[lease] for lease in self.having(*LeaseState)]
        return [person for person in self.people if live.count(person) < LEASES_MAX]

    def quiet(self, kind: str) -> bool:
        """May a breakdown of this kind happen?"""
        return len(self.driver.events) - self.broke.get(kind, 0) >= CALM_EVENTS

    def breaks(self, kind: str) -> None:
        self.broke[kind] = len(self.driver.events)

    # -- what people do
    @precondition(lambda self: bool(self.asking()))
    @rule(who=PICK, wish=WISHES)
    def acquire(self, who: int, wish: Wish) -> None:
        people = self.asking()
        size, shrink, bound, spec = wish
        steady = max(size // 2, spec["residue_bytes"]) if shrink else size
        self.ask(people[who % len(people)], size, steady, bound, spec)

    def ask(
        self, person: Consumer, size: int, steady: int, bound: float | None, spec: dict[str, Any]
    ) -> LeaseId | None:
        self.taking_over = {
            lease: size for lease in self.having(*AWAY) if self.mine[lease] is person
        }
        effects = person.try_acquire(size, steady, wait_timeout_s=bound, **spec)
        self.taking_over = {}
        reply = next((effect for effect in effects if isinstance(effect, Reply)), None)
        if reply is None:  # it can never fit
            return None
        lease = LeaseId(as_wire(reply.body)["lease"]["lease_id"])
        person.specs[lease] = person.spec(size, steady, **spec)
        self.mine[lease] = person
        if bound is not None:
            self.bounds[lease] = self.driver.now + bound
        return lease

    @precondition(some(LOADING, REVOKING))
    @rule()
    def everybody_goes_on(self) -> None:
        """Who was granted loads, who was asked leaves once it is not in use."""
        for lease in self.having(LOADING):
            self.load(lease)
        for lease in self.having(REVOKING):
            self.comply(lease)

    @precondition(some(LOADING))
    @rule()
    def load_whoever_was_granted(self) -> None:
        self.load(self.pick(0, LOADING))

    def load(self, lease: LeaseId) -> None:
        spec = self.mine[lease].specs[lease]
        process = self.mine[lease].process
        self.loaded.setdefault(process, {})[lease] = max(
            spec.footprint.steady_bytes, spec.footprint.residue_bytes
        )
        self.context[process] = max(self.context.get(process, 0), spec.footprint.residue_bytes)
        self.show(process)
        self.mine[lease].ready(lease)

    def show(self, process: ProcessKey) -> None:
        """Put on the GPU what the process holds."""
        count = max(sum(self.loaded[process].values()), self.context[process])
        self.driver.device.set(process, count, self.driver.now)

    def unload(self, lease: LeaseId) -> str:
        """The holder frees its bytes and releases. Return what the lease becomes."""
        person = self.mine[lease]
        person.unloading(lease)
        del self.loaded[person.process][lease]
        self.show(person.process)
        view = self.driver.view(lease)
        parked = view is not None and "parked_bytes" in view
        return str(answer(person.release(lease, parked=parked))["next"])

    @precondition(some(HELD))
    @rule(n=PICK, who=st.integers(0, PEOPLE - 1))
    def use(self, n: int, who: int) -> None:
        lease = self.pick(n, HELD)
        self.people[who].use_begin(lease, f"u{who}", self.mine[lease].token(lease))
        if self.people[who] is self.mine[lease]:
            self.stays.discard(lease)  # it knows

    def in_use(self) -> list[LeaseId]:
        return [lease for lease in self.having(HELD, REVOKING) if self.lease(lease).uses]

    @precondition(lambda self: bool(self.in_use()))
    @rule(n=PICK)
    def end_uses_of(self, n: int) -> None:
        found = self.in_use()
        self.end_uses(found[n % len(found)])

    def end_uses(self, lease: LeaseId) -> None:
        for n, person in enumerate(self.people):
            person.use_end(lease, f"u{n}", self.mine[lease].token(lease))

    @precondition(some(REVOKING))
    @rule(n=PICK)
    def comply_somebody(self, n: int) -> None:
        self.comply(self.pick(n, REVOKING))

    def comply(self, lease: LeaseId) -> None:
        self.mine[lease].ack(lease)
        if not self.lease(lease).uses:
            self.unload(lease)

    @precondition(lambda self: set(self.having(HELD)) - set(self.in_use()))
    @rule(n=PICK)
    def give_back(self, n: int) -> None:
        idle = [lease for lease in self.having(HELD) if not self.lease(lease).uses]
        self.unload(idle[n % len(idle)])

    @precondition(some(*AWAY, LeaseState.VERIFYING))
    @rule(n=PICK)
    def want_back(self, n: int) -> None:
        lease = self.pick(n, *AWAY, LeaseState.VERIFYING)
        self.mine[lease].reacquire(lease)

    @precondition(some(LOADING))
    @rule()
    def fail_to_load(self) -> None:
        lease = self.pick(0, LOADING)
        self.mine[lease].release(lease)

    @precondition(some(QUEUED, *AWAY))
    @rule(n=PICK)
    def cancel(self, n: int) -> None:
        self.cancel_of(self.pick(n, QUEUED, *AWAY))

    def cancel_of(self, lease: LeaseId) -> None:
        self.mine[lease].cancel(lease)

    def waited_for(self) -> list[LeaseId]:
        """Requests that a holder is revoked for."""
        asked = [self.lease(lease).departure.eviction for lease in self.having(REVOKING)]
        wanted = {one.wanted_by for one in asked if one is not None}
        return [lease for lease in self.having(QUEUED) if lease in wanted]

    @precondition(lambda self: bool(self.waited_for()))
    @rule(n=PICK)
    def give_up(self, n: int) -> None:
        """The waiter that a holder is revoked for wants nothing any more."""
        found = self.waited_for()
        self.cancel_of(found[n % len(found)])

    def told_to_stay(self) -> list[LeaseId]:
        """Idle holders that were told to stay."""
        return [lease for lease in self.having(HELD) if lease in self.stays]

    @precondition(lambda self: any(not self.lease(x).uses for x in self.told_to_stay()))
    @rule(n=PICK)
    def act_on_a_withdrawn_revoke(self, n: int) -> None:
        """The holder has not heard that it may stay: it leaves as one that is evicted does."""
        idle = [lease for lease in self.told_to_stay() if not self.lease(lease).uses]
        lease = idle[n % len(idle)]
        after = self.unload(lease)
        assert after == "standby" or not self.mine[lease].specs[lease].standby

    @precondition(lambda self: self.quiet("die"))
    @rule(who=st.integers(0, PEOPLE - 1))
    def die(self, who: int) -> None:
        self.breaks("die")
        self.loaded.pop(self.people[who].process, None)
        self.context.pop(self.people[who].process, None)
        self.people[who].die()
        self.people[who] = self.driver.consumer(f"p{who}")

    # -- what the world does
    @rule(seconds=st.sampled_from([0.002, 0.02, 0.3, 0.3, 2.0, 35.0]))
    def wait(self, seconds: float) -> None:
        if self.having(LOADING):  # the GPU is read twenty times a second then
            seconds = min(seconds, LOAD_MAX_S)
        self.driver.advance(seconds)

    @precondition(lambda self: self.quiet("stranger"))
    @rule(count=st.sampled_from([0, 100 * d.MIB, 250 * d.MIB]))
    def stranger(self, count: int) -> None:
        self.breaks("stranger")
        self.driver.device.set(STRANGER, count, self.driver.now)

    @precondition(lambda self: self.driver.device.failing or self.quiet("probe"))
    @rule()
    def probe(self) -> None:
        self.breaks("probe")
        self.driver.device.failing = "" if self.driver.device.failing else "probe died"

    @rule(deadline_s=st.sampled_from([5.0, 30.0]), waiters=st.sampled_from([2, 1000]))
    def reload(self, deadline_s: float, waiters: int) -> None:
        """Constants change while requests wait and holders leave."""
        changed = {"revoke_deadline_s": deadline_s, "verify_timeout_s": deadline_s / 3}
        self.driver.post(SettingsChanged({**changed, "waiters_max": waiters}))

    @precondition(lambda self: self.quiet("restart"))
    @rule()
    def restart(self) -> None:
        """kill -9 of the daemon: the journal survives, holders come back with their tokens, waiters
        have to ask again."""
        self.breaks("restart")
        resident = self.having(LOADING, HELD, REVOKING, LeaseState.UNLOADING)
        held = {
            lease: (self.lease(lease).state, self.mine[lease].token(lease)) for lease in resident
        }
        away = {
            lease: (self.lease(lease).state, self.mine[lease].token(lease))
            for lease in self.having(*AWAY)
        }
        self.driver.restart(epoch=self.driver.settings.epoch + 1)
        for person in self.people:
            person.connect()
        for lease, (state, token) in held.items():
            self.mine[lease].reattach(lease, token, held=state is not LOADING)
        for lease, (state, token) in away.items():
            self.mine[lease].reattach(lease, token, away=True, parked=state is LeaseState.PARKED)

    # -- what must hold after every event
    def sound(self) -> None:
        self.gpu_never_overflows()
        self.every_byte_is_charged()
        self.tokens_grow()
        self.no_lost_wake_up()
        self.waits_end_in_time()

    def gpu_never_overflows(self) -> None:
        """What is on the GPU, and what those may put there who load, fits."""
        coming = 0
        for lease in self.having(LOADING):
            person = self.mine[lease]
            peak = self.taking_over.get(lease, person.specs[lease].footprint.load_peak_bytes)
            if self.loaded.get(person.process):
                coming += peak
            else:  # its context is part of the peak
                coming += max(0, peak - self.driver.device.held.get(person.process, 0))
        assert sum(self.driver.device.shown(self.driver.now).values()) + coming <= CAPACITY

    def every_byte_is_charged(self) -> None:
        """The ledger of the core never has less for a process than the process holds. Where the
        GPU lists nobody, what one holds is known as exactly only as what an empty GPU may show.
        """
        (gpu,) = self.driver.arbiter.inspect().gpus.values()
        unsure = (
            0 if self.driver.device.lists_processes else d.RESERVE_BYTES + d.VERIFY_TOLERANCE_BYTES
        )
        for process, leases in self.loaded.items():
            held = max(sum(leases.values()), self.context[process])
            account = gpu.ledger.accounts.get(process)
            booked = 0 if account is None else account.charged_bytes
            assert booked + unsure >= held, f"{process} holds {held}, {booked} are booked"

    def tokens_grow(self) -> None:
        for effect in self.driver.effects[self.seen :]:
            match effect:
                case Push(_, RevokeWithdrawnPush(lease)):
                    self.stays.add(LeaseId(lease))
                case Push(_, RevokePush(lease)):
                    self.stays.discard(LeaseId(lease))
                case _:
                    pass
            view = getattr(effect.body, "lease", None) if isinstance(effect, Reply | Push) else None
            if view is not None and view.state == "loading":
                assert not self.tokens or view.token > self.tokens[-1]
                self.tokens.append(view.token)
                self.stays.discard(view.lease_id)
        self.seen = len(self.driver.effects)

    def no_lost_wake_up(self) -> None:
        """Whenever readings are in and nothing blocks, the head does not fit (else it would have
        been granted)."""
        core = state_of(self.driver.arbiter)
        (gpu,) = core.gpus.values()
        head = gpu.queue.head
        if head is None or core.blocked(gpu) or gpu.asked_at is not None:
            return
        room = admission.measured_room_bytes(gpu, core.now - core.settings.sample_max_age_s)
        assert not (
            admission.fits(gpu, head)
            and room is not None
            and room >= admission.measured_need_bytes(gpu, head)
        )

    def waits_end_in_time(self) -> None:
        """Who said how long he can wait is served or denied by then."""
        leases = self.driver.arbiter.inspect().leases
        for lease, until in list(self.bounds.items()):
            if lease not in leases or leases[lease].state is not QUEUED:
                del self.bounds[lease]
            else:
                assert self.driver.now <= until, f"{lease} still waits"

    # -- and in the end
    def teardown(self) -> None:
        """Everybody cooperates: uses end, who is asked leaves, pinned ones go home, processes whose
        context may be all that is in the way exit. Then every waiter is served within the bound,
        also if others keep arriving with a higher priority.
        """
        if not hasattr(self, "driver"):
            return
        self.driver.device.failing = ""
        self.driver.device.set(STRANGER, 0, self.driver.now)
        waiting = set(self.having(QUEUED))
        began = self.driver.now
        turn = 0
        while waiting:
            if turn in EXITS:
                self.die(EXITS.index(turn))
            if self.crowd:
                self.newcomers(turn)
            self.cooperate()
            waiting &= set(self.having(QUEUED))
            self.driver.advance(TURN_S)
            turn += 1
            waited = self.driver.now - began
            assert waited <= WAIT_MAX_S or not waiting, self.driver.status()

    def cooperate(self) -> None:
        for lease in self.in_use():
            self.end_uses(lease)
        self.everybody_goes_on()
        for lease in self.having(HELD):
            if not self.lease(lease).evictable:
                self.unload(lease)

    def newcomers(self, turn: int) -> None:
        """They are more urgent than anybody, leave only when asked, and exit then; another one
        comes."""
        people = {
            person.name: person for person in self.mine.values() if person.name.startswith("new")
        }
        here = [
            person
            for person in people.values()
            if any(self.mine[x] is person for x in self.having(*LeaseState))
        ]
        for person in people.values():
            if person not in here and self.loaded.pop(person.process, None) is not None:
                self.context.pop(person.process, None)
                person.die()
        if len(here) < NEWCOMERS:
            person = self.driver.consumer(f"new{turn}")
            size = SIZES[turn % len(SIZES)]
            self.ask(person, size, size, None, {"priority": max(PRIORITIES)})


TestLeases = Leases.TestCase
TestLeases.settings = walk(30)
