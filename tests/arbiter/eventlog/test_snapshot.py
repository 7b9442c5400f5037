"""The engine's whole state as a text: what comes back decides exactly as the original would have."""

import base64
import os
import pickle
import zlib
from collections import deque

import pytest

from tests.support.core_driver import START_S, CoreDriver
from tests.support.engine_state import state_of
from vram_arbiter.arbiter.core.arbiter import Arbiter
from vram_arbiter.arbiter.core.model.gpu import Gpu
from vram_arbiter.arbiter.core.settings import GpuInfo
from vram_arbiter.arbiter.eventlog import snapshot
from vram_arbiter.arbiter.eventlog.codec import digest
from vram_arbiter.arbiter.eventlog.snapshot import freeze, pack, unpack
from vram_arbiter.schemas.codec import CodecError


def copy_of(engine: Arbiter) -> Arbiter:
    return unpack(pack(freeze(engine)))


def text_of(pickled: bytes) -> str:
    return base64.b85encode(zlib.compress(pickled)).decode()


@pytest.mark.parametrize("share", [0.1, 0.35, 0.5, 0.75, 0.95])
def test_a_copy_decides_as_the_original(busy: CoreDriver, share: float) -> None:
    engine = Arbiter(busy.settings, START_S)
    cut = int(share * len(busy.events))
    for now, event in busy.events[:cut]:
        engine.handle(event, now)
    other = copy_of(engine)
    for now, event in busy.events[cut:]:
        assert digest(other.handle(event, now)) == digest(engine.handle(event, now))
    now = busy.events[-1][0]
    assert other.status(now) == engine.status(now)


def test_a_copy_shares_nothing_with_the_original(busy: CoreDriver) -> None:
    engine = Arbiter(busy.settings, START_S)
    for now, event in busy.events[:200]:
        engine.handle(event, now)
    before = freeze(engine)
    other = copy_of(engine)
    for now, event in busy.events[200:]:
        other.handle(event, now)
    assert freeze(engine) == before


class Evil:
    """Pickles itself as a call."""

    def __init__(self, call: object, *arguments: object) -> None:
        self._reduced = call, arguments

    def __reduce__(self) -> object:  # type: ignore[override]
        return self._reduced


@pytest.mark.parametrize(
    ("thing", "says"),
    [
        (Evil(os.system, "exit 3"), "no class of the engine"),
        (Evil(getattr, Gpu, "in_state"), "no class of the engine"),
        (print, "no class of the engine"),
        (Evil(GpuInfo, "g"), "cannot be read: TypeError"),
        (deque([1]), "a deque where the engine should be"),
    ],
)
def test_only_the_engines_own_data_is_made(thing: object, says: str) -> None:
    """A log may be another user's file: nothing in it is called but the engine's classes."""
    with pytest.raises(CodecError, match=says):
        unpack(text_of(pickle.dumps(({}, thing))))


def test_a_name_with_a_dot_leads_nowhere() -> None:
    """A pickle may name `Arbiter.handle`, or what lies behind it."""
    for name in ("Arbiter.handle", "Arbiter.handle.__globals__", "Lease"):
        module = "vram_arbiter.arbiter.core.arbiter"
        call = b"\x80\x04\x8c" + bytes([len(module)]) + module.encode()
        call += b"\x8c" + bytes([len(name)]) + name.encode() + b"\x93."
        with pytest.raises(CodecError, match="no class of the engine"):
            unpack(text_of(call))


def test_a_version_with_other_fields_refuses_the_state(
    busy: CoreDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    own = snapshot._shapes()
    key = next(name for name in own if name.endswith(":GpuInfo"))
    monkeypatch.setattr(snapshot, "_shapes", lambda: {**own, key: (*own[key], "color")})
    text = pack(freeze(busy.arbiter))
    with pytest.raises(CodecError, match=r"GpuInfo has other fields: \['color'\]"):
        unpack(text)


def test_a_function_in_the_state_is_refused(busy: CoreDriver) -> None:
    engine = copy_of(busy.arbiter)
    state_of(engine).settings = print  # type: ignore[assignment]
    with pytest.raises(CodecError, match="no class of the engine"):
        copy_of(engine)


@pytest.mark.parametrize("text", ["", "x", "~~~~~", text_of(b""), text_of(pickle.dumps(7))])
def test_a_broken_state_is_a_codec_error(text: str) -> None:
    with pytest.raises(CodecError):
        unpack(text)
