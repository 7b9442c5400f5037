"""Byte sizes as people write them and as we print them. Inside the product a size is always an int
of bytes."""

from typing import Annotated

from pydantic import BeforeValidator, Field

from vram_arbiter.schemas.sizes import format_bytes, parse_bytes


def _size(value: object) -> object:
    return parse_bytes(value) if isinstance(value, str) else value


ByteSize = Annotated[int, BeforeValidator(_size), Field(ge=0)]
"""Pydantic field type: an int of bytes that also reads the texts of `parse_bytes`."""

__all__ = ["ByteSize", "format_bytes", "parse_bytes"]
