"""Byte sizes as people write them and as we print them. Inside the product a size is always an int
of bytes."""

from typing import Annotated

from pydantic import BeforeValidator, Field, GetJsonSchemaHandler
from pydantic.json_schema import JsonSchemaValue
from pydantic_core import CoreSchema

from vram_arbiter.schemas.sizes import format_bytes, parse_bytes


def _size(value: object) -> object:
    return parse_bytes(value) if isinstance(value, str) else value


TEXT_PATTERN = r"^\s*[0-9]+(\.[0-9]+)?\s*([kKmMgGtT][iI]?)?[bB]?\s*$"


class _OrText:
    """JSON Schema of a size: its numbers, or the texts that `parse_bytes` reads, so that an editor
    accepts `8GiB`."""

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> JsonSchemaValue:
        number = handler(schema)
        for bound, keyword in (("ge", "minimum"), ("gt", "exclusiveMinimum"), ("le", "maximum")):
            if bound in number:  # pydantic's own words, which no validator knows
                number[keyword] = number.pop(bound)
        return {"anyOf": [number, {"type": "string", "pattern": TEXT_PATTERN}]}


ByteSize = Annotated[int, BeforeValidator(_size), Field(ge=0), _OrText()]
"""Pydantic field type: an int of bytes that also reads the texts of `parse_bytes`."""

__all__ = ["ByteSize", "format_bytes", "parse_bytes"]
