"""What nobody should send: valid requests of every op, drawn from the wire's own schema, and
everything that can be made of them.

One generator for the property tests and the hostile clients. It draws from a
`random.Random` that it is given (Hypothesis hands one in whose draws it can shrink). Must not know
sessions, sockets or the core.
"""

import random
import struct
from collections.abc import Mapping, Sequence
from typing import Any

import msgpack

from vram_arbiter.arbiter.rpc import codec
from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
from vram_arbiter.schemas.export import definitions
from vram_arbiter.schemas.wire import requests, spec

_SCHEMA = {**definitions(spec), **definitions(requests)}
_BY_OP: Mapping[str, Mapping[str, Any]] = {
    op: _SCHEMA[cls.__name__] for op, cls in requests.REQUESTS.items()
}
OPS = tuple(requests.REQUESTS)
ANSWER_MAX_BYTES = 16_384
OPTIONAL = 0.4  # of the fields that may be left out, how many are there

BOMBS: Mapping[str, bytes] = {
    "deep arrays": b"\x91" * 100_000,
    "deep maps": b"\x81\xa1k" * 100_000,
    "array of four billion": b"\xdd\xff\xff\xff\xff",
    "map of four billion": b"\xdf\xff\xff\xff\xff",
    "text of four billion": b"\xdb\xff\xff\xff\xff",
    "bytes of four billion": b"\xc6\xff\xff\xff\xff",
    "extension of four billion": b"\xc9\xff\xff\xff\xff\x01",
    "array of a million nulls": b"\xdd\x00\x0f\x42\x3f" + b"\xc0" * 999_999,
    "timestamp of a wrong size": b"\xc7\x05\xff\x00\x00\x00\x00\x00",
    "timestamp beyond a second": b"\xd7\xff" + b"\xff" * 8,
    "extension": msgpack.packb({"op": "ping", "id": 1, "x": msgpack.ExtType(5, b"abc")}),
    "never used byte": b"\xc1",
    "duplicate keys": b"\x84\xa2op\xa4ping\xa2op\xa3bye\xa2id\x01\xa2id\x02",
    "text that is no utf-8": b"\x82\xa2op\xa4\xff\xfe\xfd\xfc\xa2id\x01",
    "surrogates": b"\x82\xa2op\xa4ping\xa2id\xa3\xed\xa0\x80",
    "two values": msgpack.packb({"op": "ping", "id": 1}) * 2,
    "numbers as keys": msgpack.packb({1: 2, "op": "ping", "id": 1}),
    "bytes as keys": b"\x82\xc4\x02op\xa4ping\xa2id\x01",
    "not a number": msgpack.packb({"op": "cancel", "id": float("nan"), "lease_id": float("inf")}),
    "id of 64 bits": msgpack.packb({"op": "ping", "id": (1 << 64) - 1}),
    "negative id": msgpack.packb({"op": "ping", "id": -(1 << 63)}),
    "id that is true": msgpack.packb({"op": "ping", "id": True}),
    "empty": b"",
}
"""Frames by what is wrong with them. None of them is a request that may be obeyed twice, raise, or
cost memory."""


class Forger:
    """Draws requests and frames. `lease_ids` and `tokens` are those to try; callers add what they
    learn."""

    def __init__(self, draw: random.Random) -> None:
        self._draw = draw
        self.lease_ids: list[str] = ["L1-1"]
        self.tokens: list[Sequence[int]] = [(1, 2)]

    def request(self, op: str | None = None, **fields: Any) -> dict[str, Any]:
        """A request that the wire accepts."""
        op = op or self._draw.choice(OPS)
        message: dict[str, Any] = self._sample(_BY_OP[op], "")
        return {**message, "op": op, **fields}

    def mutant(self, message: Mapping[str, Any]) -> Any:
        """The request with one to three things wrong, at any depth."""
        broken: Any = dict(message)
        for _ in range(self._draw.randint(1, 3)):
            broken = self._mutate(broken)
        return broken

    def frame(self) -> bytes:
        """Bytes to send: a mutant, a request with wrong bytes in it, a bomb, or noise."""
        match self._draw.randint(0, 9):
            case 0:
                return self._draw.choice(list(BOMBS.values()))
            case 1:
                return bytes(self._draw.randint(0, 255) for _ in range(self._draw.randint(0, 60)))
            case 2 | 3:
                return self._wound(msgpack.packb(self.request()))
            case _:
                return pack(self.mutant(self.request()))

    # -- valid
    def _sample(self, schema: Mapping[str, Any], name: str) -> Any:
        draw = self._draw
        if "$ref" in schema:
            return self._sample(_SCHEMA[schema["$ref"].rpartition("/")[2]], name)
        if "const" in schema:
            return schema["const"]
        if "enum" in schema:
            return draw.choice(schema["enum"])
        if "anyOf" in schema:
            return self._sample(draw.choice(schema["anyOf"]), name)
        match schema["type"]:
            case "object":
                required = schema.get("required", ())
                return {
                    key: self._sample(value, key)
                    for key, value in schema["properties"].items()
                    if key in required or draw.random() < OPTIONAL
                }
            case "array":
                return self._array(schema, name)
            case "string":
                return self._text(schema, name)
            case "integer":
                least, most = (
                    schema.get("minimum", 0),
                    schema.get("maximum", schema.get("exclusiveMaximum", 101) - 1),
                )
                return draw.choice([least, most, draw.randint(least, min(most, least + 100))])
            case "number":
                return draw.choice(
                    [schema.get("minimum", 0), schema.get("minimum", 0) + draw.random(), 3600.0]
                )
            case "boolean":
                return draw.random() < 0.5
            case _:
                return None

    def _array(self, schema: Mapping[str, Any], name: str) -> Any:
        if name == "token":
            return list(self._draw.choice(self.tokens))
        if "prefixItems" in schema:
            return [self._sample(item, name) for item in schema["prefixItems"]]
        return [self._sample(schema["items"], name) for _ in range(self._draw.randint(0, 3))]

    def _text(self, schema: Mapping[str, Any], name: str) -> str:
        if name in ("lease_id", "target"):
            return self._draw.choice(self.lease_ids)
        if name == "cgroup":
            return self._draw.choice(["/a", "/a/b.service", "/" + "x" * 1023])
        text: str = self._draw.choice(
            ["a", "u1", "any", "0", "L1-1", "π", "x" * schema.get("maxLength", 20)]
        )
        return text[: schema.get("maxLength", 1000)]

    # -- wrong
    def _mutate(self, value: Any) -> Any:
        draw = self._draw
        if isinstance(value, dict) and value:
            key = draw.choice(sorted(value, key=repr))
            match draw.randint(0, 4):
                case 0:
                    return {k: v for k, v in value.items() if k != key}
                case 1:
                    return {
                        **value,
                        draw.choice(["extra", "op", "id", "", "\x00", 7]): self._junk(),
                    }
                case _:
                    return {**value, key: self._mutate(value[key])}
        if isinstance(value, list) and value and draw.random() < 0.7:
            at = draw.randrange(len(value))
            return [*value[:at], self._mutate(value[at]), *value[at + 1 :]]
        return self._junk()

    def _junk(self) -> Any:
        draw = self._draw
        return draw.choice(
            [
                None, True, -1, 0, 1 << 53, (1 << 64) - 1, -(1 << 63), 1e308, float("nan"),
                float("inf"), -0.0, "", "x" * 5000,
                "\x00", "\ud7ff", "ping", b"\xff", [], {}, [[]] * 100, {"op": "bye"}, [1, 2, 3],
                msgpack.ExtType(1, b"x"),
                msgpack.Timestamp(0, 1), draw.randint(-1000, 1000), draw.choice(self.lease_ids),
                list(draw.choice(self.tokens)),
            ]
        )  # fmt: skip

    def _wound(self, frame: bytes) -> bytes:
        draw = self._draw
        at = draw.randrange(len(frame))
        match draw.randint(0, 3):
            case 0:
                return frame[:at]
            case 1:
                return frame[:at] + bytes([draw.randint(0, 255)]) + frame[at + 1 :]
            case 2:
                return frame[:at] + frame[draw.randrange(len(frame)) :]
            case _:
                return frame[:at] + struct.pack(">BI", 0xDD, draw.getrandbits(32)) + frame[at:]


def pack(value: Any) -> bytes:
    """msgpack of anything that a mutant may hold."""
    packed: bytes = msgpack.packb(value, strict_types=False, unicode_errors="surrogatepass")
    return packed


def code_of(frame: bytes) -> str:
    """`ok`, or the code of the error; anything else that is raised fails the test."""
    try:
        codec.decode(frame, MESSAGE_MAX_BYTES)
    except codec.Undecodable as bad:
        answer = codec.refusal(bad.request_id, 1, bad.error.view())
        assert len(answer) <= ANSWER_MAX_BYTES, "a refusal never echoes what it refuses at length"
        return bad.error.code
    return "ok"
