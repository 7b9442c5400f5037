"""Which events a rule matches, how an event is handed over, and sample events."""

import json
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from enum import Enum
from fnmatch import fnmatchcase
from types import NoneType, UnionType
from typing import Any, Final, Literal, NewType, TypeAliasType, Union, get_args, get_origin
from typing import get_type_hints as hints_of

from vram_arbiter.schemas.config.hooks import ALIASES, EVICTED, Hook
from vram_arbiter.schemas.plain import JsonMap, JsonObject
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE
from vram_arbiter.schemas.wire.notes import NOTES, About

PREFIX: Final = "VRAM_ARBITER_EVENT_"
VALUE_MAX_CHARS: Final = 4096
"""Of a variable; the whole event is on stdin."""
_OF_LEASE: Final = frozenset({"pressure", "stowaway", "probe_failed", "probe_ok", "serving"})
"""Kinds of the engine that are not about a lease."""


@dataclass(frozen=True, slots=True)
class Delivery:
    """One event for one rule. `on`: the name in the rule that it matched; `dropped`: events that
    the rule lost before it; `key`: the same for the same event and rule, always."""

    rule: str
    on: str
    event: JsonMap
    key: str
    dropped: int = 0

    @property
    def body(self) -> bytes:
        """The event as JSON."""
        return json.dumps(self.event, separators=(",", ":")).encode()


def matched(hook: Hook, event: JsonMap) -> str | None:
    """Return the name in `hook.on` that an event matches; None: it does not concern the rule."""
    if not fnmatchcase(str(event.get("consumer") or ""), hook.consumer):
        return None
    return next((name for name in hook.on if _is(event, name)), None)


def _is(event: JsonMap, name: str) -> bool:
    kind = event["kind"]
    if name != EVICTED:
        return bool(kind == ALIASES.get(name, name))
    # a revoked holder begins to unload, or releases without having said so
    return (kind == "unloading" and event.get("asked") is True) or (
        kind == "released" and event.get("was") == "revoking"
    )


def environ_of(delivery: Delivery, endpoint: str) -> Mapping[str, str]:
    """Return the variables of a command: every plain value of the event, and the rule."""
    found = {
        ENDPOINT_VARIABLE: endpoint,
        "VRAM_ARBITER_HOOK": delivery.rule,
        "VRAM_ARBITER_HOOK_ON": delivery.on,
        "VRAM_ARBITER_HOOK_KEY": delivery.key,
        "VRAM_ARBITER_HOOK_DROPPED": str(delivery.dropped),
    }
    for key, value in delivery.event.items():
        if isinstance(value, str | int | float):
            text = str(value).lower() if isinstance(value, bool) else str(value)
            found[PREFIX + key.upper()] = text.replace("\0", "")[:VALUE_MAX_CHARS]
    return found


# -- samples
def sample(hook: Hook, on: str) -> Delivery:
    """Return a made-up event of a kind, for `vramctl hooks test`."""
    kind = "unloading" if on == EVICTED else ALIASES.get(on, on)
    event: JsonObject = {"seq": 0, "at_wall_s": 0.0, "kind": kind}
    if kind in NOTES:
        about = {} if kind in _OF_LEASE else _of(About)
        event |= about | _of(NOTES[kind])
    if on == EVICTED:
        event["asked"] = True
    if "consumer" in event and "*" in hook.consumer:
        event["consumer"] = hook.consumer.replace("*", "sample")
    event["reason"] = "a sample event of `vramctl hooks test`"
    return Delivery(hook.name, on, event, f"sample-{hook.name}")


def _of(cls: Any) -> JsonObject:
    hints = hints_of(cls)
    return {one.metadata.get("part") or one.name: _value(hints[one.name]) for one in fields(cls)}


def _value(hint: Any) -> Any:
    """Return a plain value of a type of `schemas.wire.notes`."""
    while isinstance(hint, NewType | TypeAliasType):
        hint = hint.__supertype__ if isinstance(hint, NewType) else hint.__value__
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is Literal:
        return arguments[0]
    if origin in (Union, UnionType):
        return _value(next(one for one in arguments if one is not NoneType))
    if origin is tuple:
        return []
    if isinstance(hint, type) and issubclass(hint, Enum):
        return next(iter(hint)).value
    if hint in (int, float, bool):
        return hint(hint is not bool)
    return _of(hint) if is_dataclass(hint) and fields(hint) else "sample"
