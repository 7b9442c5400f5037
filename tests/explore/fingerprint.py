"""Which worlds are the same: `fingerprint` is equal for worlds in which the same may happen.

A world is written down in parts: its clients, each GPU with the leases on it, and the rest. In it

- clients that are alike are named in the order of what they are in, leases by their owners, tokens
  and requests in the order in which they are met;
- a moment is its place among the others of its part, before now or after: the order of what
  happened on one GPU matters, and which deadline is next. How long ago it was matters for the
  newest reading alone, which may be too old. Deadlines at other distances in the same order are one
  state, explored as it is met first;
- what no decision reads, or only a choice among equals, is left out (`LEFT_OUT`): numbers of
  events, words for people, learned durations.

GPUs are not renamed: the engine breaks ties by their index, so that two of them are not alike.
A field that is new in the engine counts until it is named here.
"""

from bisect import bisect
from collections import deque
from collections.abc import Callable, Collection, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from hashlib import blake2b
from marshal import dumps
from operator import attrgetter
from typing import Any

from tests.explore.clients import Hand, Talker
from tests.explore.world import FAR_S, Device, World
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.events import MemorySampled, ProcessUse
from vram_arbiter.arbiter.core.ledger import Account, Charge, GpuLedger
from vram_arbiter.arbiter.core.model import lease as m
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.records import AnyRecord, LeaseRecord, ResidueRecord
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.clients._protocol import records as r
from vram_arbiter.schemas.ids import ProcessKey, Token
from vram_arbiter.schemas.wire.spec import LeaseSpec

LEFT_OUT: Mapping[type, str] = {
    m.Lease: "request uses story held_from id",
    m.Request: "nonce arrival arrived_at uid id traceparent reason wait_timeout_s evicted"
    " earlier_nonces",
    m.Eviction: "consumer charge_bytes unloading_at released_at verdict_at traceparent",
    m.Observed: "grew_at drifted",
    m.Use: "label began_at",
    m.Verification: "key consumer model",
    Account: "leased_bytes leased_approved_bytes charged_bytes approved_bytes held_bytes",
    Charge: "account",
    GpuLedger: "tolerance_bytes info budget_bytes charges touched stowaway_bytes charged_bytes"
    " approved_bytes _held_bytes",
    Gpu: "info queue readings residents verifications left reading_s failure blocked debts dirty"
    " touched",
    ProcessUse: "name",
    MemorySampled: "total_bytes",
    LeaseRecord: "lease_id token pid start_ticks nonce spec held_from users pinned",
    ResidueRecord: "pid start_ticks",
    Hand: "name spec client connections lives",
    Talker: "name spec client connections lives protocol up down record awaited",
    r.LeaseRecord: "nonce spec view ttl_s revoke wanted_by reacquire_id",
    r.Waiter: "nonce spec traceparent asked_at request_id",
}


def fingerprint(world: World) -> int:
    """Return 64 bits that tell a world from those that are not the same."""
    return int.from_bytes(blake2b(canonical(world), digest_size=8).digest())


def canonical(world: World) -> bytes:
    """Return what is written down of a world."""
    core = state_of(world.engine)
    order = sorted(world.clients.values(), key=lambda client: _rank(core, client))
    names: dict[object, int] = {}
    for number, client in enumerate(order, 1):
        names[client.process] = names[client.client] = number
        names |= {f"{client.name}-{n}": -number for n in range(1, client.connections)}
    parts = [_clients(core, order, names)]
    for device in world.devices.values():
        parts.append(_gpu(core, core.gpus[device.gpu], device, names))
    parts.append(_rest(world, core, names))
    return dumps([part.sealed(world.now) for part in parts], 2)


def _rank(core: Core, client: Any) -> tuple[object, ...]:
    """Return where a client stands among all; those that are alike and in the same state by the
    order of their requests."""
    lease = core.leases.get(client.lease)
    met = (-1, "") if lease is None else (lease.request.arrival, lease.state)
    return client.spec.consumer, *client.standing(), *reversed(met)


# -- writing
class _Part:
    """Values in one row. Names are shared by the parts of a world."""

    def __init__(self, names: dict[object, int]) -> None:
        self.names = names
        self.row: list[Any] = []

    def put(self, *values: Any) -> None:
        append = self.row.append
        for value in values:
            kind = type(value)
            if kind is int or kind is bool or value is None:
                append(value)
            elif kind is float:
                append(value or 0)
            else:
                _WRITERS[kind](self, value)

    def name(self, thing: object) -> int:
        """Return the number of what has a name of its own; a new one where it has none yet."""
        return self.names.setdefault(thing, len(self.names) + 1)

    def sealed(self, now: float) -> tuple[Any, ...]:
        """Return the row, with moments as their places: below zero those that are over."""
        moments = sorted({value for value in self.row if type(value) is float})
        far, over = bisect(moments, now + FAR_S), bisect(moments, now)
        places = {at: f"{n - over}" if n < far else "far" for n, at in enumerate(moments)}
        return tuple([places[value] if type(value) is float else value for value in self.row])


type _Writer = Callable[[_Part, Any], None]


class _Writers(dict[type, _Writer]):
    """How values of a class are written."""

    def __missing__(self, kind: type) -> _Writer:
        return self.setdefault(kind, _writer_for(kind))


_WRITERS = _Writers()


def _writer_for(kind: type) -> _Writer:
    if kind is str:
        return _text
    if issubclass(kind, Enum):
        return lambda part, value: part.row.append(value.value)
    if kind in (ProcessKey, Token):
        return lambda part, value: part.row.append(part.name(value))
    if kind is LeaseSpec:
        return lambda part, value: part.row.append(value.consumer)
    if issubclass(kind, dict):
        return _table
    if issubclass(kind, set | frozenset):
        return lambda part, value: _sequence(part, sorted(value, key=lambda one: _key(part, one)))
    if issubclass(kind, list | tuple | deque):
        return _sequence
    return _record_writer(kind)


def _text(part: _Part, value: str) -> None:
    is_lease = value[:1] == "L" and value[1:2].isdigit()
    part.row.append(part.name(value) if is_lease else part.names.get(value, value))


def _key(part: _Part, value: object) -> tuple[bool, Any]:
    named = part.names.get(value)
    return named is None, str(value) if named is None else named


def _table(part: _Part, table: dict[Any, Any]) -> None:
    part.row.append(len(table))
    for key in sorted(table, key=lambda one: _key(part, one)) if len(table) > 1 else table:
        part.put(key, table[key])


def _sequence(part: _Part, values: Collection[Any]) -> None:
    part.row.append(len(values))
    part.put(*values)


def _record_writer(kind: type) -> _Writer:
    left_out = LEFT_OUT.get(kind, "").split()
    getters: list[Callable[[Any], Any]] = []  # made with the first value: it knows its fields

    def write(part: _Part, value: Any) -> None:
        if not getters:
            every = [one.name for one in fields(value)] if is_dataclass(value) else vars(value)
            names = [name for name in every if name not in left_out]
            getters.append(attrgetter(*names, "__class__.__name__"))
        part.put(*getters[0](value))

    return write


# -- the parts of a world
def _clients(core: Core, order: Iterable[Any], names: dict[object, int]) -> _Part:
    part = _Part(names)
    for client in order:
        part.put(client.spec, client)
        if isinstance(client, Talker):
            _protocol(part, client)
        nonces = [
            (nonce, id) for (process, nonce), id in core.nonces.items() if process == client.process
        ]
        part.put(sorted(nonces))
    return part


def _protocol(part: _Part, client: Talker) -> None:
    connection, holdings = client.protocol.connection, client.protocol.holdings
    part.put(connection.phase, connection._phase_deadline, connection._heard_at)
    part.put(connection.asked_at, connection._pinged, part.name((client.process, client.awaited)))
    for record in (*holdings.held.values(), *holdings.asleep.values()):
        part.put(record, record.revoke is not None, record is client.record)
    part.put(client.record and client.record.lease_id, list(client.protocol.waits.waiters.values()))
    for pending in connection._pending.values():
        part.put(pending.request.TAG[1], part.name((client.process, pending.id)))
        part.put(getattr(pending.request, "lease_id", ""), getattr(pending.request, "token", None))
        part.put(pending.deadline, pending.sent_at is not None, pending.quiet)
    for message in (*client.up, "down", *client.down):
        _message(part, client, message)


def _message(part: _Part, client: Talker, message: Any) -> None:
    """A message without its numbers and times."""
    match message:
        case dict():
            for key, value in sorted(message.items()):
                if key in ("id", "re"):
                    part.put(part.name((client.process, value)))
                elif key == "token" and value is not None:
                    part.put(Token(*value))
                elif key not in ("seq", "epoch", "message", "hint", "details", "instance"):
                    part.row.append(key)
                    _message(part, client, value)
        case list():
            for value in message:
                _message(part, client, value)
        case float():
            pass
        case _:
            part.put(message)


def _gpu(core: Core, gpu: Gpu, device: Device, names: dict[object, int]) -> _Part:
    part = _Part(names)
    part.put(gpu, device, [(one.id, one.request.arrived_at) for one in gpu.queue])
    part.put(list(gpu.verifications.values()))
    oldest = core.now - core.settings.sample_max_age_s
    part.put(gpu.sample is not None and gpu.sample.taken_at < oldest)
    used = sorted(gpu.in_state(m.LeaseState.HELD), key=lambda lease: lease.uses.last_at)
    part.put([lease.id for lease in used])  # the least recently used first
    residents = sorted(gpu.residents.values(), key=lambda lease: part.name(lease.id))
    for lease in residents:
        _lease(part, core, lease)
    old = [one.baseline for one in gpu.verifications.values()]
    old += [lease.departure.baseline for lease in residents] + [gpu.sample]
    since = min([reading.taken_at for reading in old if reading is not None], default=0.0)
    part.put([one for one in gpu.left if one[0] > since])
    part.put(
        [core.timers.get((kind, gpu.info.id)) for kind in ("probe", "verify", "plan", "return")]
    )
    return part


def _lease(part: _Part, core: Core, lease: m.Lease) -> None:
    request = lease.request
    part.put(lease.id, lease, list(lease.uses.values()), lease.uses.unclaimed)
    if lease.state is m.LeaseState.QUEUED:
        part.put(request, request.id is None)
    else:
        part.put(request.load_peak_bytes, request.steady_bytes, request.gpus)
    kinds = ("ttl", "wait", "revoke", "users", "away")
    part.put([core.timers.get((kind, lease.id)) for kind in kinds])


def _rest(world: World, core: Core, names: dict[object, int]) -> _Part:
    part = _Part(names)
    elsewhere = [lease for lease in core.leases.values() if lease.gpu is None]
    for lease in sorted(elsewhere, key=lambda lease: part.name(lease.id)):
        _lease(part, core, lease)
    part.put(core.serving, core.drain, core.recovering, list(core.away), core.host_ram)
    part.put(core.terminated, set(core.clients))
    part.put([at for (kind, _), at in core.timers.items() if kind == "recover"])
    part.put([core.footprints.expected_bytes(spec) for spec in world.scenario.clients])
    part.put(core.costs.failures)
    over = [lease for lease in core.ended if lease in names]
    part.put({lease: core.ended[lease].state for lease in over})
    part.put(world.left, world.lied, world.disk_full, world.unheard, len(world.owed))
    if world.left.get("restart"):
        records = sorted(world.journal.items(), key=lambda item: _owner(part, *item))
        for key, record in records:
            part.put(*_owner(part, key, record), record)
            if isinstance(record, LeaseRecord):
                users = {ProcessKey(pid, ticks) for pid, ticks, _, _ in record.users}
                part.put(users, record.pinned is None)
    return part


def _owner(part: _Part, key: str, record: AnyRecord) -> tuple[str, int, str]:
    """Return whose a record of the journal is, and of which GPU."""
    match record:
        case LeaseRecord():
            return "lease", part.name(record.lease_id), record.gpu or ""
        case ResidueRecord():
            return "residue", part.name(ProcessKey(record.pid, record.start_ticks)), record.gpu
        case _:
            return key, 0, ""
