"""Plain data at a boundary: JSON texts and files, YAML, and the msgpack maps of a wire.

Behind its boundary it is a frozen dataclass or a pydantic model. Free fields of a model are
`dict[str, pydantic.JsonValue]`, which refuses whatever JSON cannot say.
"""

from collections.abc import Mapping
from typing import Any

type JsonObject = dict[str, Any]
"""A JSON object before it is validated, or ready to be written."""
type JsonMap = Mapping[str, Any]
"""A JSON object that is only read."""
type Message = dict[str, Any]
"""One map of a wire, not validated yet or ready to be sent: a JSON object that may have `bytes`,
and arrays where the wire says so."""
