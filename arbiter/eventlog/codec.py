"""Lines of an event log: events as JSON by `schemas.codec`, effects as a digest and a summary.

Numbers come back as they were: nothing is converted, so that a replay sees the very same values.
The digest is over all bytes of the effects, in order. Knows nothing of files.
"""

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import fields, is_dataclass
from functools import cache
from hashlib import blake2b
from operator import attrgetter
from typing import Any, Final, get_args

import msgpack
import pydantic_core

from vram_arbiter.arbiter.core.effects import Effect, Note, Push
from vram_arbiter.arbiter.core.events import Event
from vram_arbiter.schemas.codec import CodecError, from_map, to_map

EVENTS: Final[Mapping[str, type]] = {cls.__name__: cls for cls in get_args(Event)}
"""Every event of the core by its name."""


def to_json(value: object) -> str:
    """One line of a dataclass or of plain values. Raises TypeError for anything else."""
    plain = to_map(value) if is_dataclass(value) else value
    try:
        return pydantic_core.to_json(plain, fallback=_as_plain).decode()
    except pydantic_core.PydanticSerializationError:  # half a surrogate pair, or of no known type
        return _JSON.encode(value)


def decode_event(name: str, data: object) -> Event:
    """Raises CodecError for an event, a field or a shape that this version does not know."""
    if (known := EVENTS.get(name)) is None:
        raise CodecError(f"no event is called {name}")
    event: Event = from_map(known, data, strict=True)
    return event


def digest(effects: Sequence[Effect]) -> str:
    """16 hex digits over every byte of the effects, in their order. The same decisions give the
    same digest, on any machine."""
    return blake2b(_pack(list(effects)), digest_size=8).hexdigest()


def summary(effects: Sequence[Effect]) -> str:
    """The effects by kind, e.g. `Reply Note:queued Push:revoke`: what to look at where digests
    differ."""
    return " ".join(
        f"{type(effect).__name__}:{effect.body.TAG[1]}"
        if isinstance(effect, Note | Push)
        else type(effect).__name__
        for effect in effects
    )


def _as_plain(value: Any) -> Any:
    if is_dataclass(value):
        return to_map(value)
    if isinstance(value, Mapping):
        return dict(value)
    if isinstance(value, set | frozenset):
        return sorted(value)
    raise TypeError(f"{type(value).__name__} has no place in a log")


_JSON = json.JSONEncoder(separators=(",", ":"), default=_as_plain)


@cache
def _values_of(cls: Any) -> Callable[[Any], Sequence[object]] | None:
    """Return what takes a dataclass apart: the name of its class and its values."""
    if not is_dataclass(cls):
        return None
    names = [field.name for field in fields(cls)]
    take_apart = attrgetter("__class__.__name__", *names)
    return take_apart if names else lambda value: (take_apart(value),)  # of one alone: no tuple


def _packable(value: Any) -> Any:
    cls: Any = type(value)
    take_apart = _values_of(cls)
    return _as_plain(value) if take_apart is None else take_apart(value)


_pack: Callable[[object], bytes] = msgpack.Packer(default=_packable).pack
"""One for all: each has a buffer of its own, of 256 KiB."""
