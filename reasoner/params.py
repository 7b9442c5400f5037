"""Check of a call's goal parameters against the schema in the skill's manifest, before sending.

Covers the part of JSON Schema that manifests use: `type`, `properties`, `required`,
`additionalProperties: false`, `enum`, `items`, `minItems`, `maxItems`, `minimum`, `maximum`. Other
keywords are left to the skill, which checks its goal as well.
"""

from collections.abc import Mapping
from typing import Any

_TYPES: dict[str, tuple[type, ...]] = {
    "object": (dict,),
    "array": (list,),
    "string": (str,),
    "number": (int, float),
    "integer": (int,),
    "boolean": (bool,),
    "null": (type(None),),
}


type JsonSchema = Mapping[str, Any]
"""A JSON Schema, as a manifest holds it."""


def misfits(value: Any, schema: Any, path: str = "goal_params") -> list[str]:
    """Return the mistakes of a value, each with its path; empty if it fits."""
    if not isinstance(schema, Mapping):
        return []
    kinds = schema.get("type", [])
    kinds = [kinds] if isinstance(kinds, str) else kinds
    if isinstance(kinds, list) and kinds and not any(_is(value, kind) for kind in kinds):
        return [f"{path}: must be of type {' or '.join(map(str, kinds))}"]
    options = schema.get("enum")
    if isinstance(options, list) and value not in options:
        return [f"{path}: must be one of {', '.join(map(repr, options))}"]
    if isinstance(value, dict):
        return _object(value, schema, path)
    if isinstance(value, list):
        wrong = _outside(len(value), schema, ("minItems", "maxItems"), "have {} items", path)
        for index, item in enumerate(value):
            wrong += misfits(item, schema.get("items"), f"{path}[{index}]")
        return wrong
    if isinstance(value, int | float) and not isinstance(value, bool):
        return _outside(value, schema, ("minimum", "maximum"), "be {}", path)
    return []


def _is(value: Any, kind: Any) -> bool:
    types = _TYPES.get(kind) if isinstance(kind, str) else None
    if types is None:
        return True  # a word that this check does not know refuses nothing
    if isinstance(value, bool):
        return bool in types
    return isinstance(value, types) or (
        kind == "integer" and isinstance(value, float) and value.is_integer()
    )


def _object(value: dict[str, Any], schema: JsonSchema, path: str) -> list[str]:
    known, required = schema.get("properties"), schema.get("required")
    known = known if isinstance(known, Mapping) else {}
    wrong = [
        f"{path}.{name}: is required"
        for name in (required if isinstance(required, list) else [])
        if isinstance(name, str) and name not in value
    ]
    for name, item in value.items():
        if name in known:
            wrong += misfits(item, known[name], f"{path}.{name}")
        elif schema.get("additionalProperties") is False:
            wrong.append(f"{path}.{name}: is not a parameter of this skill")
    return wrong


def _outside(
    size: float, schema: JsonSchema, words: tuple[str, str], told: str, path: str
) -> list[str]:
    """Return why a size is not within the two bounds that `words` name."""
    least, most = (schema.get(word) for word in words)
    if isinstance(least, int | float) and size < least:
        return [f"{path}: must {told.format(f'at least {least}')}"]
    if isinstance(most, int | float) and size > most:
        return [f"{path}: must {told.format(f'at most {most}')}"]
    return []
