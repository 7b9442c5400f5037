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
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from marshal import dumps
from operator import attrgetter
from types import NoneType
from typing import Any

from tests.explore.client import Client
from tests.explore.world import FAR_S, Device, World
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.model import lease as m
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.model.records import LeaseRecord
from vram_arbiter.arbiter.core.model.state import Core
from vram_arbiter.schemas.ids import ProcessKey, Token
from vram_arbiter.schemas.wire.errors import Refusal
from vram_arbiter.schemas.wire.spec import LeaseSpec

_LEFT_OUT_BECAUSE: Mapping[str, str] = {
    "it is written elsewhere, or a sum": "request spec id key info queue readings residents left"
    " verifications touched debts dirty blocked account leased_bytes leased_approved_bytes"
    " total_bytes budget_bytes tolerance_bytes",
    "it is a number, or words": "story nonce arrival arrived_at uid reason traceparent label"
    " began_at failure name consumer model earlier_nonces",
    "it is learned, or told alone": "grew_at drifted reading_s evicted charge_bytes held_from"
    " unloading_at released_at verdict_at wait_timeout_s",
    "it is of the protocol, and never changes": "foreign_uses _above _hello _connection _holdings"
    " instance epoch heartbeat_s grace_s view ttl_s deadline_in_s priority lists",
    "it is of a message, and told alone": "message hint details pid since_s waited_s granted_s"
    " ttl_left_s",
    "it is of the protocol, and an order of messages": "connections lives protocol up down record"
    " awaited _ids outgoing events _pending _handshake_id _handshake_at _heard_at reacquire_id"
    " request_id renewed_at deadline on_reply on_error",
}
LEFT_OUT = frozenset(name for names in _LEFT_OUT_BECAUSE.values() for name in names.split())
"""Fields of any record by name."""
_NAMED = frozenset({str, ProcessKey, Token})
_PLAIN = frozenset({int, bool, NoneType})
type Names = dict[object, int]


def fingerprint(world: World) -> int:
    """Return 64 bits that tell a world from those that are not the same, in this process."""
    return hash(canonical(world))


def canonical(world: World) -> bytes:
    """Return what is written down of a world."""
    core = state_of(world.engine)
    order = sorted(world.clients.values(), key=lambda client: _rank(core, client))
    names: Names = {}
    for number, client in enumerate(order, 1):
        names[client.process] = names[client.client] = number
        names |= {f"{client.name}-{n}": -number for n in range(1, client.connections)}
    parts = [_client(core, client, names) for client in order]
    parts += [_gpu(core, core.gpus[one.gpu], one, names) for one in world.devices.values()]
    parts.append(_rest(world, core, names))
    return dumps([part.sealed(world.now) for part in parts], 2)


def _rank(core: Core, client: Client) -> tuple[object, ...]:
    """Return where a client stands among all; those that are alike and in the same state by the
    order of their requests."""
    lease = core.leases.get(client.lease)
    met = ("", -1) if lease is None else (lease.state.value, lease.request.arrival)
    return client.spec.consumer, *client.standing(), *met


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
            kind = type(value)
            if kind in _PLAIN:
                row.append(value)
            elif kind is float:
                self.moments.append(len(row))
                row.append(value)
            elif kind in _NAMED:
                named = names.get(value)
                if named is None and (
                    kind is not str or (value[:1] == "L" and value[1:2].isdigit())
                ):
                    named = names[value] = len(names) + 1
                row.append(value if named is None else named)
            elif not value:
                row.append(0)
            else:
                _WRITERS[kind](self, value)

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


type _Writer = Callable[[_Part, Any], None]


class _Writers(dict[type, _Writer]):
    """How values of a class are written."""

    def __missing__(self, kind: type) -> _Writer:
        return self.setdefault(kind, _writer(kind))


_WRITERS = _Writers()


def _writer(kind: type) -> _Writer:
    if issubclass(kind, Enum):
        return lambda part, value: part.row.append(value._value_)
    if issubclass(kind, Refusal):
        return lambda part, value: part.put(value.code)
    if kind is LeaseSpec:
        return lambda part, value: part.row.append(value.consumer)
    if issubclass(kind, dict):
        return _write_table
    if issubclass(kind, set | frozenset):
        return lambda part, some: part.put_all((len(some), *_sorted(part, some)))
    if issubclass(kind, list | tuple | deque):
        return lambda part, some: part.put_all((len(some), *some))
    return _record_writer()


def _write_table(part: _Part, table: dict[Any, Any]) -> None:
    part.row.append(len(table))
    for key in _sorted(part, table):
        part.put_all((key, table[key]))


def _sorted(part: _Part, keys: Any) -> Any:
    return sorted(keys, key=lambda key: str(part.names.get(key, key))) if len(keys) > 1 else keys


def _record_writer() -> _Writer:
    getter: Callable[[Any], Any] | None = None  # made with the first value: it knows its fields

    def write(part: _Part, value: Any) -> None:
        nonlocal getter
        if getter is None:
            names = list(_fields(value))
            # the module fills up: a getter of one name returns no tuple
            getter = attrgetter(*names, *["__module__"] * (2 - len(names)))
        part.put_all(getter(value))

    return write


def _fields(record: Any) -> Iterator[str]:
    """Yield the names of what is written of a record, and of the records that it always has."""
    hints = {one.name: one.type for one in fields(record)} if is_dataclass(record) else {}
    for name in hints or vars(record):
        if name in LEFT_OUT:
            continue
        inner = getattr(record, name)
        if is_dataclass(inner) and hints.get(name) is type(inner):
            yield from (f"{name}.{one}" for one in _fields(inner))
        else:
            yield name


# -- the parts of a world
def _client(core: Core, client: Client, names: Names) -> _Part:
    part, connection = _Part(names), client.protocol.connection
    part.put(client.spec, client, client.record is None, client.protocol)
    for number in (client.awaited, connection._handshake_id):
        part.put(part.name((client.process, number)))
    for number, pending in connection._pending.items():
        part.put_all((part.name((client.process, number)), pending))
        part.put(pending.request.TAG[1], pending.request)
    for mail in (client.up, client.down):
        part.put(len(mail))
        for re, body in mail:
            part.put(re and part.name((client.process, re)), type(body).__name__, body)
    mine = {id: nonce for (process, nonce), id in core.nonces.items() if process == client.process}
    part.put(mine)
    return part


def _gpu(core: Core, gpu: Gpu, device: Device, names: Names) -> _Part:
    part = _Part(names)
    residents = sorted(gpu.residents.values(), key=lambda lease: part.name(lease.id))
    part.put(gpu, device, [(one.id, one.request.arrived_at) for one in gpu.queue])
    part.put(list(gpu.verifications.values()))
    for lease in residents:
        _lease(part, core, lease)
    oldest = core.now - core.settings.sample_max_age_s
    part.put(gpu.sample is not None and gpu.sample.taken_at < oldest)
    used = sorted(gpu.in_state(m.LeaseState.HELD), key=lambda lease: lease.uses.last_at)
    part.put([lease.id for lease in used])  # the least recently used first
    baselines = [one.baseline for one in gpu.verifications.values()]
    baselines += [gpu.sample, *(lease.departure.baseline for lease in residents)]
    since = min([reading.taken_at for reading in baselines if reading is not None], default=0.0)
    part.put([one for one in gpu.left if one[0] > since])
    part.put(
        *[core.timers.get((kind, gpu.info.id)) for kind in ("probe", "verify", "plan", "return")]
    )
    return part


def _lease(part: _Part, core: Core, lease: m.Lease) -> None:
    request = lease.request
    part.put(lease.id, lease, lease.uses.unclaimed)
    if lease.state is m.LeaseState.QUEUED:
        part.put(request, request.id is None)
    else:
        part.put(request.load_peak_bytes, request.steady_bytes, request.gpus)
    kinds = ("ttl", "wait", "revoke", "users", "away")
    part.put(*[core.timers.get((kind, lease.id)) for kind in kinds])


def _rest(world: World, core: Core, names: Names) -> _Part:
    part = _Part(names)
    elsewhere = [lease for lease in core.leases.values() if lease.gpu is None]
    for lease in sorted(elsewhere, key=lambda lease: part.name(lease.id)):
        _lease(part, core, lease)
    part.put(core.serving, core.recovering, list(core.away), core.host_ram, set(core.clients))
    part.put(*[at for (kind, _), at in core.timers.items() if kind == "recover"])
    part.put([core.footprints.expected_bytes(spec) for spec in world.scenario.clients])
    part.put(core.costs.failures, world.left, world.lied, world.unheard)
    part.put({lease: core.ended[lease].state for lease in core.ended if lease in names})
    if world.left.get("restart"):
        for key in _sorted(part, {key.partition(":")[2]: key for key in world.journal}):
            _journaled(part, world.journal[f"lease:{key}" if key[0] == "L" else f"residue:{key}"])
    return part


def _journaled(part: _Part, record: Any) -> None:
    part.put(ProcessKey(record.pid, record.start_ticks), record.gpu)
    if isinstance(record, LeaseRecord):
        part.put(record.lease_id, record.state, record.charge_bytes, record.measured_bytes)
        part.put(record.comes_back, [ProcessKey(pid, ticks) for pid, ticks, _, _ in record.users])
    else:
        part.put(record.residue_bytes, record.floor_bytes)
