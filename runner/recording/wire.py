"""Messages between the runner and its dataset writer: a msgpack header, then the raw pictures.

One stream socket, one message after the other. A stream that ends, even within a message, means
that the other side has ended.
"""

from __future__ import annotations

import socket
import struct
from collections.abc import Sequence
from typing import Any

import msgpack

HEADER_MAX_BYTES = 1 << 20
BLOB_MAX_BYTES = 64 << 20  # a picture of 21 million pixels
_LENGTH = struct.Struct(">I")

Header = dict[str, Any]


def send(peer: socket.socket, header: Header, blobs: Sequence[bytes] = ()) -> None:
    """Send all of it. Blocks.

    Raises OSError when the other side is gone, ValueError if it is too large.
    """
    packed = msgpack.packb({**header, "blobs": [len(blob) for blob in blobs]})
    if len(packed) > HEADER_MAX_BYTES or any(len(blob) > BLOB_MAX_BYTES for blob in blobs):
        raise ValueError(f"a message of {len(packed)} bytes and {len(blobs)} pictures is too large")
    peer.sendall(_LENGTH.pack(len(packed)) + packed)
    for blob in blobs:
        peer.sendall(blob)


def receive(peer: socket.socket) -> tuple[Header, list[bytes]] | None:
    """Return the next message; None when the other side is gone.

    Raises ValueError for anything else.
    """
    try:
        if (prefix := _exactly(peer, _LENGTH.size)) is None:
            return None
        (length,) = _LENGTH.unpack(prefix)
        if length > HEADER_MAX_BYTES:
            raise ValueError(f"a header of {length} bytes")
        if (packed := _exactly(peer, length)) is None:
            return None
        header: Header = msgpack.unpackb(packed)
        blobs = []
        for size in header.pop("blobs"):
            if not 0 <= size <= BLOB_MAX_BYTES:
                raise ValueError(f"a picture of {size} bytes")
            if (blob := _exactly(peer, size)) is None:
                return None
            blobs.append(blob)
    except ConnectionError:
        return None
    return header, blobs


def _exactly(peer: socket.socket, size: int) -> bytes | None:
    data = bytearray(size)
    view = memoryview(data)
    done = 0
    while done < size:
        got = peer.recv_into(view[done:])
        if got == 0:
            return None
        done += got
    return bytes(data)
