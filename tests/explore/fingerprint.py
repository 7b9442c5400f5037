"""Which worlds are the same: `fingerprint` is equal for worlds in which the same may happen.

A world is written down in parts: each client, each GPU with the leases on it, the rest. In it

- clients that are alike are named in the order of what they are in, leases and tokens in the order
  in which they are met;
- a moment is its place among the others of its part, before now or after: the order of what
  happened on one GPU matters, and which deadline is next. How long ago it was matters for the
  newest reading alone, which may be too old. Deadlines at other distances in the same order are one
  state, explored as it is met first;
- what no decision reads, or only a choice among equals, is left out (`LEFT_OUT`): numbers of
  events, words for people, learned durations. A field that is new in the engine counts until it is
  named there.

GPUs are not renamed: the engine breaks ties by their index, so that two of them are not alike.
"""

from bisect import bisect
from collections import defaultdict, deque
from collections.abc import Callable, Iterable, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from functools import cache
from marshal import dumps
from operator import attrgetter
from types import NoneType
from typing import Any

from tests.explore.world import FAR_S, Client, World
from tests.support.core_driver import SimDevice
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.model.lease import Lease, LeaseState
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.ids import ProcessKey, Token
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.spec import LeaseSpec

_LEFT_OUT_BECAUSE: Mapping[str, str] = {
    "it is written elsewhere, or a sum": "request id key info queue readings residents left"
    " verifications touched debts dirty blocked account leased_bytes leased_approved_bytes"
    " total_bytes budget_bytes tolerance_bytes",
    "it is a number, or words": "story nonce arrival arrived_at uid reason traceparent label"
    " began_at failure name consumer model earlier_nonces",
    "it is learned, or told alone": "grew_at drifted reading_s evicted charge_bytes held_from"
    " unloading_at released_at verdict_at wait_timeout_s",
    "it is of the protocol, and never changes": "foreign_uses _above _hello _connection _holdings"
    " instance epoch heartbeat_s grace_s view ttl_s deadline_in_s priority",
    "it is of a message, and told alone": "message hint details pid since_s waited_s granted_s"
    " ttl_left_s",
    "it is of the protocol, and an order of messages": "connections lives up down"
    " _ids outgoing events _pending _handshake_id _handshake_at _heard_at reacquire_id"
    " request_id renewed_at deadline on_reply on_error",
}
LEFT_OUT = frozenset(name for names in _LEFT_OUT_BECAUSE.values() for name in names.split())
"""Fields of any record by name."""
_JOURNALED = [
    "state",
    "gpu",
    "charge_bytes",
    "measured_bytes",
    "comes_back",
    "residue_bytes",
    "floor_bytes",
]
_NAMED = frozenset({str, ProcessKey, Token})
_PLAIN = frozenset({int, bool, NoneType})
type Names = dict[object, int]
type Timers = dict[str, dict[str, float]]


def fingerprint(world: World) -> int:
    """Return 64 bits that tell a world from those that are not the same, in this process."""
    return hash(canonical(world))


def canonical(world: World) -> bytes:
    """Return what is written down of a world."""
    core = state_of(world.engine)
    names: Names = {}
    order = sorted(world.clients.values(), key=lambda client: _rank(core, client))
    for number, client in enumerate(order, 1):
        names[client.process] = names[client.client] = number
        names |= {f"{client.name}-{n}": -number for n in range(1, client.connections)}
    timers: Timers = defaultdict(dict)
    for (kind, subject), at in core.timers.items():
        timers[subject][kind] = at
    parts = [_client(core, client, names) for client in order]
    parts += [_gpu(world, core, device, names, timers) for device in world.devices.values()]
    parts.append(_rest(world, core, names, timers))
    return dumps([part.sealed(world.now) for part in parts], 2)


def _rank(core: Core, client: Client) -> tuple[object, ...]:
    """Return where a client stands among all; those that are alike and in the same state by the
    order of their requests."""
    mine = [(one.state.value, one.request.arrival) for one in core.leases_of(client.process)]
    return client.spec.consumer, *client.standing(), mine


# -- writing
class _Part:
    """Values in one row, and where in it moments are. Names are shared by the parts of a world."""

    def __init__(self, names: Names) -> None:
        self.names = names
        self.row: list[Any] = []
        self.moments: list[int] = []

    def put(self, *values: Any) -> None:
        self.put_all(values)

    def put_all(self, values: Iterable[Any]) -> None:
        row, names = self.row, self.names
        for value in values:
            kind: type = type(value)
            if kind in _PLAIN:
                row.append(value)
            elif kind is float:
                self.moments.append(len(row))
                row.append(value)
            elif kind in _NAMED:
                named = kind is not str or value[:1] == "L" or value in names  # a lease's id
                row.append(self.name(value) if named else value)
            elif value:
                _writer(kind)(self, value)
            else:
                row.append(0)

    def name(self, thing: object) -> int:
        """Return the number of what has a name of its own; a new one where it has none yet."""
        return self.names.setdefault(thing, len(self.names) + 1)

    def sealed(self, now: float) -> list[Any]:
        """Return the row, with moments as their places: below zero those that are over."""
        row = self.row
        moments = sorted({row[place] for place in self.moments})  # 0.0: never
        far, over = bisect(moments, now + FAR_S), bisect(moments, now)
        places = {at: f"{n - over}" if n < far else "far" for n, at in enumerate(moments)}
        for place in self.moments:
            row[place] = places[row[place]]
        return row


@cache
def _writer(kind: type) -> Callable[[_Part, Any], None]:
    """Return how values of a class are written."""
    if issubclass(kind, Enum):
        return lambda part, value: part.row.append(value._value_)
    if kind is LeaseSpec:
        return lambda part, value: part.row.append(value.consumer)
    if issubclass(kind, Refusal):
        return lambda part, value: part.put(value.code)
    if issubclass(kind, dict):
        return _write_table
    if issubclass(kind, set | frozenset):
        return lambda part, some: part.put_all((len(some), *_sorted(part, some)))
    if issubclass(kind, list | tuple | deque):
        return lambda part, some: part.put_all((len(some), *some))
    if is_dataclass(kind):
        names = [one.name for one in fields(kind) if one.name not in LEFT_OUT]
        # two more than the fields: of one name it returns no tuple
        values = attrgetter("__class__.__name__", "__module__", *names)
        return lambda part, value: part.put_all(values(value))
    return lambda part, value: part.put_all(
        [field for name, field in vars(value).items() if name not in LEFT_OUT]
    )


def _write_table(part: _Part, table: dict[Any, Any]) -> None:
    part.row.append(len(table))
    for key in _sorted(part, table):
        part.put_all((key, table[key]))


def _sorted(part: _Part, keys: Any) -> Any:
    return sorted(keys, key=lambda key: str(part.names.get(key, key))) if len(keys) > 1 else keys


# -- the parts of a world
def _client(core: Core, client: Client, names: Names) -> _Part:
    part, connection = _Part(names), client.protocol.connection

    def number(request: int | None) -> int | None:
        return request and part.name((client.process, request))

    part.put(client, number(connection._handshake_id))
    for pending in connection._pending.values():
        part.put(number(pending.id), pending.request, pending)
    part.put(len(client.up))
    for asked in client.up:
        part.put(number(asked.id), asked.request)
    for told in client.down:
        part.put(number(getattr(told, "request", None)), told)
    mine = {id: nonce for (process, nonce), id in core.nonces.items() if process == client.process}
    part.put(mine)
    return part


def _gpu(world: World, core: Core, device: SimDevice, names: Names, timers: Timers) -> _Part:
    part, gpu = _Part(names), core.gpus[device.gpu]
    residents = sorted(gpu.residents.values(), key=lambda lease: part.name(lease.id))
    part.put(device.held, device.late, world.readings.get(device.gpu), device.gpu in world.again)
    part.put(gpu, [(one.id, one.request.arrived_at) for one in gpu.queue])
    part.put(list(gpu.verifications.values()))
    for lease in residents:
        _lease(part, lease, timers)
    oldest = core.now - core.settings.sample_max_age_s
    part.put(gpu.sample is not None and gpu.sample.taken_at < oldest)
    used = sorted(gpu.in_state(LeaseState.HELD), key=lambda lease: lease.uses.last_at)
    part.put([lease.id for lease in used])  # the least recently used first
    baselines = [one.baseline for one in gpu.verifications.values()]
    baselines += [gpu.sample, *(lease.departure.baseline for lease in residents)]
    since = min([reading.taken_at for reading in baselines if reading is not None], default=0.0)
    part.put([one for one in gpu.left if one[0] > since], timers.pop(device.gpu, {}))
    return part


def _lease(part: _Part, lease: Lease, timers: Timers) -> None:
    request = lease.request
    part.put(lease.id, lease, lease.uses.unclaimed, timers.pop(lease.id, {}))
    if lease.state is LeaseState.QUEUED:
        part.put(request, request.id is None)
    else:
        part.put(request.load_peak_bytes, request.steady_bytes, request.gpus)


def _rest(world: World, core: Core, names: Names, timers: Timers) -> _Part:
    part = _Part(names)
    elsewhere = [lease for lease in core.leases.values() if lease.gpu is None]
    for lease in sorted(elsewhere, key=lambda lease: part.name(lease.id)):
        _lease(part, lease, timers)
    part.put(core.serving, core.recovering, list(core.away), core.host_ram, set(core.clients))
    part.put([core.footprints.expected_bytes(spec) for spec in world.scenario.clients])
    part.put(core.costs.failures, world.left, world.lied, world.unheard)
    part.put({lease: core.ended[lease].state for lease in core.ended if lease in names}, timers)
    if world.left.get("restart"):
        part.put(dict(map(_journaled, world.journal.values())))
    return part


def _journaled(record: Any) -> tuple[object, object]:
    process = ProcessKey(record.pid, record.start_ticks)
    told = [getattr(record, name, None) for name in _JOURNALED]
    return getattr(record, "lease_id", (process, record.gpu)), (process, told)
