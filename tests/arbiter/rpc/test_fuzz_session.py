"""Hostile connections against the session table, with a list for a core and with the real core:
nothing raises, every frame is answered exactly once, nobody else's lease changes, and when the
processes are gone nothing of them is left.
"""

import os
import random
from collections import Counter, deque
from collections.abc import Callable, Mapping, Sequence, Sized
from dataclasses import dataclass, field
from typing import Any

import hypothesis.strategies as st
import msgpack
import pytest
from hypothesis import HealthCheck, given, settings

from tests.support.connections import KeptConnection, peer_of
from tests.support.core_driver import SimDevice
from tests.support.full_check import check_arbiter
from tests.support.hostile import Forger, pack
from tests.support.messages import IDLE_STATUS, NO_EVENTS, no_reason
from vram_arbiter.arbiter.core import events as ev
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.host.executor import Executor
from vram_arbiter.arbiter.rpc import words
from vram_arbiter.arbiter.rpc.registry import SessionSettings
from vram_arbiter.arbiter.rpc.session import SessionTable
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.ids import ClientId, GpuId, ProcessKey
from vram_arbiter.schemas.runtime.peercred import Peer
from vram_arbiter.schemas.wire.explained import WhyReply
from vram_arbiter.schemas.wire.replies import HistoryReply, StatusReply

GPU = GpuId("GPU-0")
STRANGER_UID = 54_321
FRAMES = 60
VICTIM = peer_of(os.getpid())
ATTACKERS = [peer_of(pid, STRANGER_UID, STRANGER_UID) for pid in (os.getppid(), 1)]
SEED = st.integers(0, 1 << 32)  # draws through Hypothesis would cost more than what they test
SETTINGS = settings(deadline=None, max_examples=40, suppress_health_check=list(HealthCheck))


class Recording:
    """A core that answers nothing and remembers everything."""

    def __init__(self) -> None:
        self.events: list[ev.Event] = []

    def post(self, event: ev.Event) -> None:
        self.events.append(event)

    def when_read(self, answer: Callable[[], None]) -> None:
        answer()

    def status(self, *page: object, details: bool = False) -> StatusReply:
        return IDLE_STATUS

    def why(self, consumer: str) -> WhyReply:
        return no_reason(consumer)

    def concerns(self, client: ClientId) -> bool:
        return True


@dataclass
class RealCore:
    """The core with its executor, a GPU that shows nothing, a journal in a dict, and time that
    moves when told."""

    plant: "Plant"
    journal: dict[str, Mapping[str, Any]] = field(default_factory=dict)
    history: list[Mapping[str, Any]] = field(default_factory=list)

    def __post_init__(self) -> None:
        info = GpuInfo(GPU, 0, "simulated", 8 * d.GIB, d.RESERVE_BYTES)
        self.device = SimDevice(GPU, 8 * d.GIB)
        self.arbiter = Arbiter(Settings(epoch=1, gpus=(info,)), self.plant.now)
        self.executor = Executor(
            self.plant, self, self, self._sample, self.post, lambda event: None, self._signal, words
        )
        self._queue: deque[ev.Event] = deque()
        self._busy = False

    def _signal(self, process: ProcessKey, kind: str) -> None:
        """Nobody is ended here, whatever somebody agreed to."""

    # Decisions
    def post(self, event: ev.Event) -> None:
        self._queue.append(event)
        if self._busy:
            return
        self._busy = True
        while self._queue:
            self.executor.perform(self.arbiter.handle(self._queue.popleft(), self.plant.now))
            check_arbiter(self.arbiter)
        self._busy = False

    def when_read(self, answer: Callable[[], None]) -> None:
        answer()

    def status(
        self,
        reader: ProcessKey | None = None,
        after: tuple[int, float, int] | None = None,
        *,
        details: bool = False,
    ) -> StatusReply:
        return self.arbiter.status(self.plant.now, reader, after, d.STATUS_PAGE, details=details)

    def why(self, consumer: str) -> WhyReply:
        return self.arbiter.why(consumer, self.plant.now)

    def concerns(self, client: ClientId) -> bool:
        return self.arbiter.concerns(client)

    # the machine
    def apply(self, changes: Sequence[tuple[str, Mapping[str, Any] | None]]) -> None:
        for key, record in changes:
            if record is None:
                self.journal.pop(key, None)
            else:
                self.journal[key] = record

    def append(self, kind: str, data: Mapping[str, Any]) -> Mapping[str, Any]:
        self.history.append({"seq": len(self.history) + 1, "kind": kind, **data})
        return self.history[-1]

    def _sample(self, gpu: GpuId) -> None:
        self.plant.now += 0.001
        self.post(self.device.read(self.plant.now))

    def advance(self, seconds: float) -> None:
        end = self.plant.now + seconds
        while (deadline := self.arbiter.next_deadline()) is not None and deadline <= end:
            self.plant.now = max(self.plant.now + 0.0005, deadline)
            self.post(ev.Tick())
        self.plant.now = max(self.plant.now, end)


class Plant:
    """A session table between connections and a core."""

    def __init__(self, *, real: bool, **limits: int) -> None:
        self.now = 100.0
        self.connections: dict[bytes, KeptConnection] = {}
        self.serial = 0
        self.watched: set[ProcessKey] = set()
        values: dict[str, Any] = {
            "sessions_max": 50,
            "processes_max": 1000, "subscribers_max": 3,
            "operator_reserve": 0, "user_share": 1.0, "process_share": 1.0, **limits,
        }  # fmt: skip
        settings_ = SessionSettings(
            epoch=1, boot_id="b", server="test", heartbeat_s=2.0, fence_grace_s=5.0,
            message_max_bytes=d.MESSAGE_MAX_BYTES,
            operators_gid=None, **values,
        )  # fmt: skip
        self.core: Any = Recording() if not real else RealCore(self)
        self.table = SessionTable(settings_, self.core, self._read, self, lambda: self.now)

    # Watch
    def take(self, process: ProcessKey, pidfd: int) -> bool:
        new = process not in self.watched
        self.watched.add(process)
        return new

    def drop(self, process: ProcessKey) -> None:
        self.watched.remove(process)

    def __getattr__(self, name: str) -> Any:
        """The executor's way out, until the table is there."""
        return getattr(self.table, name)

    def _read(
        self,
        after: int,
        limit: int,
        kinds: tuple[str, ...],
        done: Callable[[HistoryReply], None],
        before: int | None,
    ) -> None:
        done(NO_EVENTS)

    def connection(self, via: bytes, peer: Peer) -> KeptConnection:
        if via not in self.connections:
            self.serial += 1
            self.connections[via] = KeptConnection(self.serial, peer)
            self.table.connected(self.connections[via])
        return self.connections[via]

    def hang_up(self, via: bytes) -> None:
        if via in self.connections:
            self.table.disconnected(self.connections.pop(via), "the peer hung up")

    def say(self, via: bytes, peer: Peer, frame: bytes) -> list[dict[str, Any]]:
        """Deliver a message; the answers (not pushes) to it. A connection that the table closed is
        opened again."""
        if via in self.connections and self.connections[via].closed:
            self.hang_up(via)
        connection = self.connection(via, peer)
        before = len(connection.sent)
        self.table.received(connection, frame)
        return [answer for answer in connection.sent[before:] if "re" in answer]

    def ask(self, via: bytes, peer: Peer, op: str, **fields: Any) -> dict[str, Any]:
        (answer,) = self.say(via, peer, msgpack.packb({"op": op, "id": 1, **fields}))
        return answer

    def hello(self, via: bytes, peer: Peer, **fields: Any) -> dict[str, Any]:
        facts = {"version": d.WIRE_VERSION, "name": "n", "instance": via.hex(), **fields}
        return self.ask(via, peer, "hello", **facts)

    def everybody_dies(self) -> None:
        """The kernel tells of every process that was watched."""
        for process in sorted(self.watched):
            self.table.process_died(process)
            self.core.post(ev.ProcessDied(process))
        for name in list(self.connections):
            self.hang_up(name)

    def leftovers(self) -> dict[str, int]:
        """Everything that the table remembers of somebody."""
        registry = self.table._registry
        tables: dict[str, Sized] = {
            "sessions": registry.sessions,
            "subscribers": registry.subscribers,
            "moved": registry.moved,
            "of_process": registry._of_process,
            "of_user": registry._of_user,
            "instances": registry._instances,
            "watched": registry._watched,
        }
        return {name: len(table) for name, table in tables.items() if table}


def attack_table(plant: Plant, draw: random.Random, forger: Forger) -> Counter[int]:
    """Hellos, valid requests, mutants, bombs and noise over a few connections of two processes.
    Counts answers per frame."""
    counts: Counter[int] = Counter()
    connections = [(b"c%d" % number, ATTACKERS[number % 2]) for number in range(6)]
    for number in range(FRAMES):
        name, peer = draw.choice(connections)
        match draw.randint(0, 5):
            case 0:
                role = draw.choice(["client", "client", "observer", "operator"])
                frame = pack(forger.request("hello", id=number, version=d.WIRE_VERSION, role=role))
            case 1 | 2 | 3:
                frame = pack(forger.request(id=number))
            case _:
                frame = forger.frame()
        answers = plant.say(name, peer, frame)
        counts[len(answers)] += 1
        for answer in answers:
            learn(forger, answer)
        if draw.random() < 0.1:
            plant.now += draw.random()
        if draw.random() < 0.05:
            plant.hang_up(draw.choice(connections)[0])
    return counts


def learn(forger: Forger, answer: Mapping[str, Any]) -> None:
    """A clever attacker uses what it was told."""
    lease = answer.get("lease")
    if isinstance(lease, Mapping):
        forger.lease_ids.append(lease["lease_id"])
        if lease["token"] is not None:
            forger.tokens.append(lease["token"])


@SETTINGS
@given(SEED)
def test_nothing_raises_and_nothing_is_left(seed: int) -> None:
    draw = random.Random(seed)
    plant = Plant(real=False)
    counts = attack_table(plant, draw, Forger(draw))
    assert max(counts) <= 1, "nothing is answered twice"
    plant.everybody_dies()
    assert not plant.leftovers()


@SETTINGS
@given(SEED)
def test_the_core_answers_every_frame_once_and_leaves_others_alone(seed: int) -> None:
    draw = random.Random(seed)
    plant = Plant(real=True)
    core: RealCore = plant.core
    core.advance(0.1)
    plant.hello(b"victim", VICTIM)
    spec = {"consumer": "victim", "model_id": "m", "evictable": False, "ttl_s": 3600.0,
            "footprint": {"load_peak_bytes": d.GIB, "steady_bytes": d.GIB,
            "residue_bytes": 0}}  # fmt: skip
    lease = plant.ask(b"victim", VICTIM, "acquire", nonce="v", spec=spec)["lease"]
    on = {"lease_id": lease["lease_id"], "token": lease["token"]}
    assert plant.ask(b"victim", VICTIM, "ready", **on)["ok"]
    forger = Forger(draw)
    forger.lease_ids += [lease["lease_id"], "victim"]
    forger.tokens.append(lease["token"])  # stolen
    counts = attack_table(plant, draw, forger)
    assert set(counts) <= {1}, f"every frame is answered exactly once: {counts}"
    core.advance(draw.choice([0.0, 1.0, 40.0]))
    (mine,) = (view for view in to_map(core.status())["leases"] if view["consumer"] == "victim")
    assert (mine["state"], mine["token"], mine["lease_id"]) == (
        "held",
        lease["token"],
        lease["lease_id"],
    )
    assert plant.ask(b"victim", VICTIM, "renew", leases=[on])["alive"] == [lease["lease_id"]]
    plant.everybody_dies()
    core.advance(60.0)
    status = to_map(core.status())
    assert (status["leases"], status["clients"], status["gpus"][0]["charged_bytes"]) == ([], 0, 0)
    assert not plant.leftovers()
    assert not core.journal, "nothing is kept for a next start"


@pytest.mark.parametrize("sessions_max", [1, 4])
def test_at_the_limit_of_sessions_hellos_are_refused_and_remembered_by_nobody(
    sessions_max: int,
) -> None:
    plant = Plant(real=True, sessions_max=sessions_max)
    answers = [plant.hello(b"h%d" % number, ATTACKERS[0]) for number in range(200)]
    assert sum(answer["ok"] for answer in answers) == sessions_max
    assert len(plant.table) == plant.core.status().clients == sessions_max
    plant.everybody_dies()
    assert not plant.leftovers()


def test_an_instance_that_reconnects_for_ever_is_one_session() -> None:
    plant = Plant(real=True)
    for number in range(300):
        assert plant.hello(b"r%d" % number, ATTACKERS[0], instance="same")["ok"]
    assert len(plant.table) == plant.core.status().clients == 1
    assert plant.leftovers()["moved"] == 1, "only the connection before this one is remembered"
    plant.everybody_dies()
    assert not plant.leftovers()
    assert plant.core.status().clients == 0
