"""The model of a request, found in a body that arrives in pieces."""

import json

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vram_arbiter.schemas.errors import BadRequest
from vram_arbiter.sidecars.gateway.routing import Finder, JsonFinder, finder_of

TEXT = st.text(max_size=20) | st.sampled_from(
    ["model", "stream", '"model"', "\\", 'a"b', "é", "x" * 3000]
)
VALUES = st.recursive(
    st.none() | st.booleans() | st.integers() | TEXT,
    lambda inner: st.lists(inner, max_size=3) | st.dictionaries(TEXT, inner, max_size=3),
    max_leaves=10,
)


def fed(finder: Finder, body: bytes, size: int) -> int:
    """Feed pieces of this size until no more is needed. Return the bytes that were fed."""
    for at in range(0, len(body), size):
        if finder.feed(body[at : at + size]):
            return min(at + size, len(body))
    return len(body)


@settings(max_examples=40)
@given(
    st.dictionaries(TEXT.filter(lambda key: key not in ("model", "stream")), VALUES, max_size=4),
    TEXT.filter(lambda name: 0 < len(name) <= 100),
    st.booleans(),
    st.integers(0, 4),
    st.integers(1, 40),
    st.booleans(),
)
def test_model_and_stream_are_those_of_the_outermost_object(
    others: dict[str, object], name: str, stream: bool, place: int, size: int, ascii_: bool
) -> None:
    items = list(others.items())
    items[place:place] = [("model", name), ("stream", stream)]
    body = json.dumps(dict(items), ensure_ascii=ascii_, indent=place or None).encode()
    finder = finder_of("application/json", streams=True)
    fed(finder, body, size)
    assert (finder.model, finder.stream) == (name, stream)


def test_no_more_is_read_than_needed() -> None:
    body = b'{"model": "a", "messages": "' + b"x" * 1000
    finder = finder_of("application/json; charset=utf-8")
    assert fed(finder, body, 20) == 20
    assert finder.model == "a"


def test_a_long_string_is_not_kept() -> None:
    """Pictures come as strings of megabytes; each piece is looked at once."""
    finder = JsonFinder({b'"model"'})
    finder.feed(b'{"image": "')
    for _ in range(100):
        assert not finder.feed(b"A" * 65536)
    assert len(finder._data) < 70_000
    assert finder.feed(b'model", "model": "m"}')
    assert finder.model == "m"


def test_a_key_with_a_long_beginning_is_another_key() -> None:
    finder = finder_of("application/json")
    finder.feed(b'{"' + b"y" * 5000)
    assert not finder.feed(b'model": "wrong", ')
    assert finder.model is None


@pytest.mark.parametrize(
    "body",
    [b"[]", b"{}", b'{"a": {"model": "x"}}', b'["model", "x"]', b'"model"', b'{"a": "model"}'],
)
def test_a_body_without_a_model_has_none(body: bytes) -> None:
    finder = finder_of("application/json")
    fed(finder, body, 3)
    assert finder.model is None


@pytest.mark.parametrize(
    "body",
    [b'{"model": 7}', b'{"model": null}', b'{"model": ""}', b'{"model": "' + b"x" * 5000,
     b"[" * 600,
     b'{"model" "x"' + b" " * 2000],
)  # fmt: skip
def test_what_cannot_be_a_model_is_refused(body: bytes) -> None:
    with pytest.raises(BadRequest):
        fed(finder_of("application/json"), body, 7)


def form(*parts: tuple[str, bytes]) -> bytes:
    body = b"preamble\r\n" if len(parts) > 2 else b""
    for name, value in parts:
        body += b'--B\r\nContent-Disposition: form-data; name="%s"\r\n\r\n' % name.encode()
        body += value + b"\r\n"
    return body + b"--B--\r\n"


@pytest.mark.parametrize("size", [1, 7, 1000])
def test_the_field_of_a_form(size: int) -> None:
    finder = finder_of("multipart/form-data; boundary=B")
    fed(finder, form(("file", b"RIFF\r\n--" * 500), ("empty", b""), ("model", b"whisper")), size)
    assert finder.model == "whisper"


def test_a_form_without_the_field_has_no_model() -> None:
    finder = finder_of("multipart/form-data; boundary=B")
    assert finder.feed(form(("file", b'name="model"'), ("a", b"model")))
    assert finder.model is None


@pytest.mark.parametrize("kind", ["text/plain", "multipart/form-data", "application/octet-stream"])
def test_other_bodies_are_refused(kind: str) -> None:
    with pytest.raises(BadRequest):
        finder_of(kind)
