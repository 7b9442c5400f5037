"""Messages as msgpack: `pack` for every sender, and bounded decoding for every server: bytes of a
peer → one map, at a bounded cost.

`unpack_map` counts the values of a message before it builds any of them: a message of 1 MiB can
hold a million lists, and building, validating and freeing those holds an event loop for seconds.
Pure: no sockets, no clock. Must not know what a message means.
"""

from dataclasses import dataclass

import msgpack

from vram_arbiter.schemas.defaults import LISTED_MAX, MESSAGE_MAX_BYTES, VALUES_MAX
from vram_arbiter.schemas.errors import BadFrame, MessageTooLarge
from vram_arbiter.schemas.plain import JsonMap, Message

HEAD_BYTES = 32  # of a map's header, the key `id` and any whole number: 17 at most


def pack(message: JsonMap | list[Message]) -> bytes:
    """Texts that UTF-8 has no bytes for (halves of surrogate pairs: undecodable file names,
    arguments) are sent as `\\udcff`: an emergency stop is not lost for its words. Raises TypeError,
    ValueError and OverflowError for what msgpack does not carry."""
    try:
        packed: bytes = msgpack.packb(message, use_bin_type=True)
    except UnicodeEncodeError:
        packed = msgpack.packb(message, use_bin_type=True, unicode_errors="backslashreplace")
    return packed


@dataclass(frozen=True, slots=True)
class UnpackLimits:
    """What one message may hold. Keys and list items are values too."""

    message_max_bytes: int = MESSAGE_MAX_BYTES
    values_max: int = VALUES_MAX
    """All values of a message together, at every depth; their cost is what bounds the time of
    `unpack_map`."""
    keys_max: int = LISTED_MAX
    """Keys of one map."""
    items_max: int = LISTED_MAX
    """Items of one list."""
    beside_binary_max_bytes: int = MESSAGE_MAX_BYTES
    """All but the content of binary values, which costs a copy only; UTF-8 text is checked letter
    by letter, 2 ms a MiB."""


def unpack_map(payload: bytes | bytearray | memoryview, limits: UnpackLimits) -> Message:
    """Decode one message to a map with text keys.

    Raises:
        MessageTooLarge: more bytes or values than `limits` allows; only the headers of the values
        were read.
        BadFrame: not one msgpack map, a map or list that is too long, text that is not UTF-8, or an
        extension type.
    """
    size = len(payload)
    if size > limits.message_max_bytes:
        raise MessageTooLarge(
            f"the message has {size} bytes, the limit is {limits.message_max_bytes}",
            hint="send less in one message",
            details={"size_bytes": size, "limit_bytes": limits.message_max_bytes},
        )
    # a value takes a byte at least: a small message need not be counted
    if size > limits.values_max:
        values, binary_bytes = _walk(payload, limits.values_max)
        if values > limits.values_max:
            raise MessageTooLarge(
                f"the message has more than {limits.values_max} values (keys, list items and what "
                "they hold)",
                hint="send less in one message",
                details={"size_bytes": size, "limit_values": limits.values_max},
            )
        if size - binary_bytes > limits.beside_binary_max_bytes:
            raise MessageTooLarge(
                f"the message has {size - binary_bytes} bytes beside its binary values, the limit "
                f"is {limits.beside_binary_max_bytes}",
                hint="send pictures and arrays as binary values, and less text",
                details={"size_bytes": size, "limit_bytes": limits.beside_binary_max_bytes},
            )
    try:
        message = msgpack.unpackb(
            payload,
            raw=False,
            strict_map_key=True,
            max_map_len=limits.keys_max,
            max_array_len=limits.items_max,
            max_ext_len=0,
        )
    except (ValueError, msgpack.UnpackException, RecursionError) as error:
        raise BadFrame(
            f"the frame is not one msgpack value: {error or type(error).__name__}",
            hint="send one msgpack map per message",
        ) from None
    if not isinstance(message, dict):
        raise BadFrame(
            f"expected a msgpack map, got {type(message).__name__}",
            hint="send one msgpack map per message",
        )
    return message


def leading_id(payload: bytes | bytearray) -> int | None:
    """Return the `id` that a request begins with; None for one that begins otherwise.

    Only the first bytes are read: by it a request is refused that is too costly to decode.
    """
    unpacker = msgpack.Unpacker(raw=False, strict_map_key=True)
    unpacker.feed(payload[:HEAD_BYTES])
    try:
        unpacker.read_map_header()
        key, value = unpacker.unpack(), unpacker.unpack()
    except (ValueError, msgpack.UnpackException):
        return None
    return value if key == "id" and type(value) is int else None


def count_values(payload: bytes | bytearray | memoryview, values_max: int) -> int:
    """Number of msgpack values in `payload`, those inside maps and lists included.

    Only headers are read, at most `values_max` of them: the count ends, at more than `values_max`,
    with the header that announces too much. Torn or invalid bytes end it early; the decoder says
    what is wrong with them.
    """
    return _walk(payload, values_max)[0]


def _walk(payload: bytes | bytearray | memoryview, values_max: int) -> tuple[int, int]:
    """`count_values`, and how many bytes the contents of the binary values have."""
    counted, walked, at, end, binary_bytes = 1, 0, 0, len(payload), 0
    while walked < counted <= values_max and at < end:
        first = payload[at]
        walked += 1
        if size := _SIZES[first]:
            at += size
            continue
        length_bytes, base, held = _HEADERS[first]
        start, at = at + 1, at + 1 + length_bytes
        announced = int.from_bytes(payload[start:at]) if length_bytes else first & 0x0F
        if held:
            counted += held * announced
        else:
            at += base + announced
            if first in _BINARY:
                binary_bytes += announced
    return counted, binary_bytes


def _sizes() -> bytes:
    """Bytes of a value by its first byte; 0 where a length follows, or where it holds values."""
    sizes = [1] * 256  # small integers, nil, booleans, and 0xc1, which the decoder refuses
    sizes[0x80:0xA0] = [0] * 32  # fixmap, fixarray
    sizes[0xA0:0xC0] = range(1, 33)  # fixstr
    for first in (0xC4, 0xC5, 0xC6, 0xC7, 0xC8, 0xC9, 0xD9, 0xDA, 0xDB, 0xDC, 0xDD, 0xDE, 0xDF):
        sizes[first] = 0
    # float 32/64, uint 8..64, int 8..64, fixext 1..16
    for first, size in zip(
        (*range(0xCA, 0xD4), *range(0xD4, 0xD9)),
        (5, 9, 2, 3, 5, 9, 2, 3, 5, 9, 3, 4, 6, 10, 18),
        strict=True,
    ):
        sizes[first] = size
    return bytes(sizes)


_SIZES = _sizes()
_BINARY = (0xC4, 0xC5, 0xC6)
_HEADERS: dict[int, tuple[int, int, int]] = {
    # first byte: (bytes of the length, bytes beside the content, values per unit of length; 0: the
    # length counts bytes)
    **dict.fromkeys(range(128, 144), (0, 0, 2)),  # fixmap
    **dict.fromkeys(range(144, 160), (0, 0, 1)),  # fixarray
    0xC4: (1, 0, 0), 0xC5: (2, 0, 0), 0xC6: (4, 0, 0),  # bin
    0xC7: (1, 1, 0), 0xC8: (2, 1, 0), 0xC9: (4, 1, 0),  # ext: a byte for the type
    0xD9: (1, 0, 0), 0xDA: (2, 0, 0), 0xDB: (4, 0, 0),  # str
    0xDC: (2, 0, 1), 0xDD: (4, 0, 1),  # array
    0xDE: (2, 0, 2), 0xDF: (4, 0, 2),  # map
}  # fmt: skip
