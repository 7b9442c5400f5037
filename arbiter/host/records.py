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
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

_ADAPTERS: Final[Mapping[str, TypeAdapter[Any]]] = {
    "lease": TypeAdapter(LeaseRecord),
    "residue": TypeAdapter(ResidueRecord),
    DRAIN_KEY: TypeAdapter(DrainRecord),
    DOUBT_KEY: TypeAdapter(DoubtRecord),
}
_SPEC = frozenset(field.name for field in fields(LeaseSpec))
_SIZES = tuple(field.name for field in fields(Footprint))


def record_of(key: str, data: JsonMap) -> AnyRecord:
    """Return the record of `key`. Raises ValueError that says what is wrong with it, in one
    line."""
    adapter = _ADAPTERS.get(key.partition(":")[0])
    if adapter is None:
        raise ValueError("no part of the daemon writes such a record")
    if isinstance(spec := data.get("spec"), dict):
        data = {**data, "spec": _spec(spec)}
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


def _spec(data: JsonObject) -> JsonObject:
    """Return a spec as it is written now: version 0.1 wrote it flat."""
    if "footprint" not in data:
        gang = data.get("gang")
        if isinstance(gang, list | tuple):
            gang = dict(zip(("id", "size"), gang, strict=False))
        data = {
            **data,
            "footprint": {name: data[name] for name in _SIZES if name in data},
            "mode": "exclusive" if data.get("exclusive") else "shared",
            "on_deadline": "deny" if data.get("deny_on_deadline") else "wait",
            "gang": gang,
        }
    return {name: value for name, value in data.items() if name in _SPEC}
