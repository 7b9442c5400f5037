"""The messages of at most 1 MiB that cost the most to decode, validate and refuse, by what makes
them costly."""

from collections.abc import Mapping
from typing import Any, Final

import msgpack

from vram_arbiter.schemas.defaults import (
    LEASES_PER_CLIENT_MAX,
    LISTED_MAX,
    MESSAGE_MAX_BYTES,
    USES_PER_LEASE_MAX,
    VALUES_MAX,
)

_MIB: Final = MESSAGE_MAX_BYTES
_SIZE: Final = {"load_peak_bytes": 1, "steady_bytes": 1}
_SPEC: Final = {"consumer": "c" * 128, "model_id": "m" * 128, "footprint": _SIZE}


def _pack(**message: Any) -> bytes:
    packed: bytes = msgpack.packb({"id": 1, **message})
    assert len(packed) <= _MIB, f"{message['op']}: {len(packed)} bytes"
    return packed


def _reattach(leases: int, **fields: Any) -> bytes:
    lease = {"lease_id": "L" * 64, "token": [1, 1], "state": "held", "spec": _SPEC, **fields}
    return _pack(op="reattach", leases=[lease] * leases)


def _junk(keys: int = 60) -> dict[str, int]:
    return {f"k{number}": 0 for number in range(keys)}


_USES = min(USES_PER_LEASE_MAX, VALUES_MAX // LEASES_PER_CLIENT_MAX - 32)
_LISTS = VALUES_MAX // (LISTED_MAX + 1) - 1

COSTLY: Final[Mapping[str, bytes]] = {
    "unknown keys": msgpack.packb({"op": "ping", "id": 1, **{f"{n:x}": 0 for n in range(110_000)}}),
    "a million empty maps": b"\xdd\x00\x0f\xff\xf0" + b"\x80" * (_MIB - 16),
    "lists in lists": b"\x9f" * _MIB,
    "lists of one in each other": b"\x91" * _MIB,
    "as many maps as may be": _pack(op="ping", x=[[{}] * LISTED_MAX] * _LISTS),
    "as many texts as may be": _pack(op="ping", x=[["ü" * 80] * LISTED_MAX] * _LISTS),
    "a long text": _pack(op="why", consumer="😀" * (_MIB // 4 - 32)),
    "text that is not UTF-8 at its "
    "end": b"\x81\xa2op\xdb" + (_MIB - 9).to_bytes(4) + b"a" * (_MIB - 10) + b"\xff",
    "a long key": _pack(op="ping", **{"k" * (_MIB - 64): 1}),
    "digits for a number": _pack(op="ping") [:-1] + msgpack.packb("9" * (_MIB - 64)),
    "spaces for a number": _pack(op="cancel", lease_id=" " * (_MIB - 64)),
    "all leases with all uses": _reattach(LEASES_PER_CLIENT_MAX, use_ids=["u" * 128] * _USES),
    "all leases with uses in UTF-8": _reattach(LEASES_PER_CLIENT_MAX, use_ids=["ü" * 80] * _USES),
    "wrong uses": _reattach(20, use_ids=["\x01" * 128] * USES_PER_LEASE_MAX),
    "leases of unknown keys": _pack(op="reattach", leases=[{"spec": _junk()}] * 48),
    "unknown keys in every map": _pack(
        op="acquire", nonce="n", spec={**_junk(55), "footprint": _junk()},
        **_junk(55)
    ),
    "kinds": _pack(op="history", kinds=["k" * 4000] * LISTED_MAX),
    "duplicates": b"\xde\x00\x40" + b"\xa2op\xa4ping" * 64,
}  # fmt: skip
