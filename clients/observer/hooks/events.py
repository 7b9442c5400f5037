"""Which events a rule matches, and how an event is handed over."""

import json
from collections.abc import Mapping
from dataclasses import dataclass
from fnmatch import fnmatchcase
from typing import Final

from vram_arbiter.schemas.config.observer import ALIASES, EVICTED, Hook
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE

PREFIX: Final = "VRAM_ARBITER_EVENT_"
VALUE_MAX_CHARS: Final = 4096
"""Of a variable; the whole event is on stdin."""


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


def sample(hook: Hook, on: str) -> Delivery:
    """Return a made-up event of a kind, for `vram-observer --test-hook`."""
    kind = "unloading" if on == EVICTED else ALIASES.get(on, on)
    said = "a sample event of `vram-observer --test-hook`"
    event: JsonMap = {"seq": 0, "at_wall_s": 0.0, "kind": kind, "asked": True, "reason": said}
    event = {**event, "consumer": hook.consumer.replace("*", "sample"), "lease_id": "L0-0"}
    return Delivery(hook.name, on, event, f"sample-{hook.name}")
