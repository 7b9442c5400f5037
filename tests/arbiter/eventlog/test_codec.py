"""Events to JSON and back by their hints alone, and a digest that sees every byte of the
effects."""

import json
from dataclasses import fields, is_dataclass, make_dataclass, replace
from types import NoneType, UnionType
from typing import Any, NewType, TypeAliasType, Union, get_args, get_origin, get_type_hints

import pytest

from tests.support.core_driver import CoreDriver
from tests.support.messages import revoke
from vram_arbiter.arbiter.core.effects import JournalDelete, Note, Push, Reply, Sample
from vram_arbiter.arbiter.core.events import Asked, Event, Tick
from vram_arbiter.arbiter.core.settings import GpuInfo, Settings
from vram_arbiter.arbiter.eventlog.codec import EVENTS, decode_event, digest, summary, to_json
from vram_arbiter.schemas.codec import CodecError, from_map
from vram_arbiter.schemas.ids import ClientId, GpuId, RequestId
from vram_arbiter.schemas.wire.notes import ServingNote


def example(hint: Any) -> Any:
    """Some value of a type hint; raises KeyError for a hint that events never had so far."""
    if isinstance(hint, NewType):
        return example(hint.__supertype__)
    if isinstance(hint, TypeAliasType):
        return example(hint.__value__)
    if hasattr(hint, "__metadata__"):
        return example(hint.__origin__)
    if isinstance(hint, type) and issubclass(hint, tuple):
        return hint(*map(example, get_type_hints(hint).values()))
    if is_dataclass(hint) and isinstance(hint, type):
        hints = get_type_hints(hint)
        return hint(**{field.name: example(hints[field.name]) for field in fields(hint)})
    origin, arguments = get_origin(hint), get_args(hint)
    if origin is tuple:
        some = (arguments[0], arguments[0]) if Ellipsis in arguments else arguments
        return tuple(example(argument) for argument in some)
    if origin in (Union, UnionType):
        return example(arguments[0])
    if NoneType in arguments:
        return example(next(argument for argument in arguments if argument is not NoneType))
    if origin is not None and "Mapping" in str(origin):
        return {"key": example(arguments[1])}
    if "Literal" in str(origin):
        return arguments[-1]
    return {str: "tëxt", int: 2**40, float: 0.1 + 0.2, bool: True, Any: [1, None, "x"]}[hint]


@pytest.mark.parametrize("name", sorted(cls.__name__ for cls in get_args(Event)))
def test_every_event_survives_a_log(name: str) -> None:
    event = example(EVENTS[name])
    line = to_json(event)
    assert decode_event(name, json.loads(line)) == event
    assert "\n" not in line


def test_what_a_run_posts_survives_a_log(busy: CoreDriver) -> None:
    kinds = {type(event.request if isinstance(event, Asked) else event) for _, event in busy.events}
    assert len(kinds) > 10
    for _, event in busy.events:
        assert decode_event(type(event).__name__, json.loads(to_json(event))) == event


def test_settings_survive_a_log() -> None:
    settings = Settings(3, (GpuInfo(GpuId("g"), 0, "gpu", 8),), learnt={"a": {"load_s": 0.1}})
    assert from_map(Settings, json.loads(to_json(settings)), strict=True) == settings


def test_a_field_that_came_later_takes_its_default(busy: CoreDriver) -> None:
    event = next(event for _, event in busy.events if isinstance(event, Asked))
    data = json.loads(to_json(event))
    data.pop("traceparent", None)
    assert decode_event("Asked", data) == event


@pytest.mark.parametrize(
    ("name", "data", "says"),
    [
        ("Vanished", {}, "no event is called Vanished"),
        ("Tick", {"colour": 1}, "Tick has no field colour"),
        ("ClientLeft", {"client": "c"}, "ClientLeft lacks reason"),
        ("Tick", [], "Tick: expected a map"),
        ("Asked",
         {"client": "c", "id": 1, "request": {"op": "unloading", "lease_id": "L", "token": [1]}},
         "expected a list of 2"),
        ("Asked", {"client": "c", "id": 1, "request": {"op": "bye", "why": 1}}, "no field why"),
        ("Asked", {"client": "c", "id": 1, "request": {"op": "dance"}},
         "expected one of several kinds"),
    ],
)  # fmt: skip
def test_a_log_of_another_version_says_what_is_strange(name: str, data: Any, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        decode_event(name, data)


def test_what_is_no_data_is_refused() -> None:
    with pytest.raises(TypeError, match="no place in a log"):
        to_json({"call": print})


def test_the_digest_sees_order_kind_and_every_value() -> None:
    reply = Reply(ClientId("c"), RequestId(1), {"lease": {"uses": 1}})
    rest = [
        Push(ClientId("c"), revoke()),
        Note(ServingNote(1.0)),
        Sample(GpuId("g")),
        JournalDelete("g"),
    ]
    same = digest([reply, *rest])
    assert same == digest([reply, *rest])
    others = [
        digest([*rest, reply]),
        digest([reply, *rest[:-1]]),
        digest([reply, *rest[:2], JournalDelete("g"), Sample(GpuId("g"))]),
        digest([replace(reply, body={"lease": {"uses": 2}}), *rest]),
        digest([]),
    ]
    assert len({same, *others}) == 6
    assert summary([reply, *rest]) == "Reply Push:revoke Note:serving Sample JournalDelete"


def test_an_event_without_fields_is_an_empty_map() -> None:
    assert to_json(Tick()) == "{}"


def test_a_digest_tells_effects_without_fields_apart() -> None:
    """Regression: of a class without fields the digest had an empty map, without its name."""
    made: list[Any] = [make_dataclass(name, []) for name in ("Paused", "Resumed")]
    paused, resumed = (digest([one()]) for one in made)
    assert paused != resumed
