"""A message as the bytes of a frame: msgpack, and whatever words are in it."""

import msgpack

from vram_arbiter.schemas.plain import JsonMap, Message


def pack(message: JsonMap | list[Message]) -> bytes:
    """Texts that UTF-8 has no bytes for (halves of surrogate pairs: undecodable file names,
    arguments) are sent as `\\udcff`: an emergency stop is not lost for its words. Raises TypeError,
    ValueError and OverflowError for what msgpack does not carry."""
    try:
        packed: bytes = msgpack.packb(message, use_bin_type=True)
    except UnicodeEncodeError:
        packed = msgpack.packb(message, use_bin_type=True, unicode_errors="backslashreplace")
    return packed
