"""The engine's whole state as JSON: what comes back decides exactly as the original would have."""

import json

import pytest

from tests.support.core_driver import START_S, CoreDriver
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.eventlog.codec import digest
from vram_arbiter.arbiter.eventlog.snapshot import from_plain, to_plain
from vram_arbiter.schemas.codec import CodecError


def through_json(engine: Arbiter) -> Arbiter:
    return from_plain(json.loads(json.dumps(to_plain(engine))))


@pytest.mark.parametrize("share", [0.1, 0.5, 0.95])
def test_a_copy_decides_as_the_original(busy: CoreDriver, share: float) -> None:
    engine = Arbiter(busy.settings, START_S)
    cut = int(share * len(busy.events))
    for now, event in busy.events[:cut]:
        engine.handle(event, now)
    other = through_json(engine)
    for now, event in busy.events[cut:]:
        assert digest(other.handle(event, now)) == digest(engine.handle(event, now))
    now = busy.events[-1][0]
    assert other.status(now) == engine.status(now)


def test_a_copy_shares_nothing_with_the_original(busy: CoreDriver) -> None:
    engine = Arbiter(busy.settings, START_S)
    for now, event in busy.events[:200]:
        engine.handle(event, now)
    before = to_plain(engine)
    other = through_json(engine)
    for now, event in busy.events[200:]:
        other.handle(event, now)
    assert to_plain(engine) == before


def test_a_function_in_the_state_is_refused(busy: CoreDriver) -> None:
    engine = through_json(busy.arbiter)
    state_of(engine).settings = print  # type: ignore[assignment]
    with pytest.raises(CodecError, match="no place in the engine's state"):
        to_plain(engine)


@pytest.mark.parametrize(
    ("entry", "says"),
    [
        (["object", "os:system", {}], "no class of the engine"),
        (["object", "vram_arbiter.arbiter.core.arbiter:print", {}], "no class of the engine"),
        (["object", "vram_arbiter.arbiter.core.model.state:Any", {}], "no class of the engine"),
        (["enum", "subprocess:Popen", ["id"]], "no class of the engine"),
        (
            ["object", "vram_arbiter.arbiter.core.settings:GpuInfo", {"id": "g"}],
            "GpuInfo has other fields",
        ),
        (["list", []], "a list where the engine should be"),
        (["lambda", []], "no such thing"),
    ],
)
def test_only_the_engines_own_data_is_made(entry: object, says: str) -> None:
    with pytest.raises(CodecError, match=says):
        from_plain({"root": 0, "objects": [entry]})


@pytest.mark.parametrize(
    "data",
    [
        {},
        {"root": 3, "objects": []},
        {"root": 0, "objects": [7]},
        {"root": 0, "objects": [["tuple", [[0]]]]},
    ],
)
def test_a_broken_state_is_a_codec_error(data: dict[str, object]) -> None:
    with pytest.raises(CodecError):
        from_plain(data)
