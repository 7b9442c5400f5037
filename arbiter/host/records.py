"""Records of the journal from their plain form, checked.

A record outside its limits would end every start in a traceback, or every answer of the daemon: a
pid that no kernel gives, a token that no wire carries. Unknown fields pass, within the limits of
`schemas.strictjson`: another version may write more than is read here.
"""

from collections.abc import Mapping
from dataclasses import fields
from typing import Any, Final

from pydantic import TypeAdapter, ValidationError
from pydantic_core import to_json

from vram_arbiter.arbiter.core.events import DOUBT_KEY, DRAIN_KEY
from vram_arbiter.arbiter.core.model.records import (
    AnyRecord,
    DoubtRecord,
    DrainRecord,
    LeaseRecord,
    ResidueRecord,
)
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.wire.spec import LeaseSpec

_ADAPTERS: Final[Mapping[str, TypeAdapter[Any]]] = {
    "lease": TypeAdapter(LeaseRecord),
    "residue": TypeAdapter(ResidueRecord),
    DRAIN_KEY: TypeAdapter(DrainRecord),
    DOUBT_KEY: TypeAdapter(DoubtRecord),
}
_SPEC = frozenset(field.name for field in fields(LeaseSpec))


def record_of(key: str, data: JsonMap) -> AnyRecord:
    """Return the record of `key`. Raises ValueError that says what is wrong with it, in one
    line."""
    adapter = _ADAPTERS.get(key.partition(":")[0])
    if adapter is None:
        raise ValueError("no part of the daemon writes such a record")
    if isinstance(spec := data.get("spec"), dict):  # requests refuse fields that are not known
        data = {**data, "spec": {name: spec[name] for name in spec.keys() & _SPEC}}
    try:
        found: AnyRecord = adapter.validate_json(to_json(data), strict=True)
    except ValidationError as error:
        first = error.errors(include_url=False, include_context=False, include_input=False)[0]
        where = ".".join(str(part) for part in first["loc"])
        raise ValueError(f"{where}: {first['msg']}" if where else first["msg"]) from None
    if isinstance(found, LeaseRecord) and key != f"lease:{found.lease_id}":
        raise ValueError(f"lease_id: it is the record of {found.lease_id}")
    return found


def records_of(data: Mapping[str, JsonMap]) -> dict[str, AnyRecord]:
    """Return the records by their keys. Raises ValueError."""
    return {key: record_of(key, record) for key, record in data.items()}


def processes_of(records: Mapping[str, AnyRecord]) -> list[ProcessKey]:
    """The processes that the journal's records belong to, and those that use what belongs to
    others; each once."""
    found = set()
    for record in records.values():
        if isinstance(record, LeaseRecord | ResidueRecord):
            found.add(ProcessKey(record.pid, record.start_ticks))
        if isinstance(record, LeaseRecord):
            found.update(ProcessKey(pid, ticks) for pid, ticks, _, _ in record.users)
    return sorted(found)
