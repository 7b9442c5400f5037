"""Which model a request asks for: the `model` of its body, found while the body arrives. Pure.

Nothing is decoded but that one value: pictures of megabytes pass at the speed of `re`, and each
byte is looked at once.
"""

import json
import re
from email.message import Message
from typing import Final, Protocol

from vram_arbiter.schemas.errors import BadRequest

VALUE_MAX_BYTES: Final = 1024
"""Longest name, as it stands in a body."""
DEPTH_MAX: Final = 512
MODEL, STREAM = b'"model"', b'"stream"'
_OUTSIDE: Final = re.compile(rb'["{}\[\],]')
_INSIDE: Final = re.compile(rb'["\\]')
_VALUE: Final = re.compile(
    rb'\s*:\s*("(?:[^"\\]|\\.){0,1024}"|[^"\s,{}\[\]]{1,64}(?=[\s,}]))', re.DOTALL
)
_HEADERS_MAX_BYTES: Final = 8192
"""Of one part of a form."""


class Finder(Protocol):
    """Looks for the model in a body that arrives piece by piece.

    `model`: None until it is known. `stream`: whether the answer is to be a stream.
    """

    model: str | None
    stream: bool

    def feed(self, data: bytes) -> bool:
        """Return whether no more is needed. Raises BadRequest for what cannot name a model."""
        ...


def finder_of(content_type: str, *, streams: bool = False) -> Finder:
    """Return what finds the model in a body of this type; with `streams` `stream` too, which most
    bodies have behind it. Raises BadRequest."""
    header = Message()
    header["content-type"] = content_type or "application/json"
    kind = header.get_content_type()
    if kind == "multipart/form-data":
        boundary = header.get_param("boundary")
        if not isinstance(boundary, str) or not 1 <= len(boundary) <= 200:
            raise BadRequest("multipart/form-data without a boundary", hint="see RFC 2046")
        return FormFinder(boundary.encode("latin-1", "replace"))
    if kind == "application/json" or kind.endswith("+json"):
        return JsonFinder({MODEL, STREAM} if streams else {MODEL})
    raise BadRequest(
        f"expected application/json or multipart/form-data, got {kind}",
        hint="a path below /upstream/NAME takes any body",
    )


class JsonFinder:
    """Finds keys of the outermost object; what is in deeper objects and in strings is passed
    over."""

    def __init__(self, wanted: set[bytes]) -> None:
        self.model: str | None = None
        self.stream = False
        self._wanted = set(wanted)
        self._data = bytearray()
        self._at = 0  # what is before it was looked at
        self._depth = 0
        self._string: int | None = None  # where the string begins in which it is
        self._is_key = False  # the next string of the outermost object is a key
        self._over = False  # the object is closed

    def feed(self, data: bytes) -> bool:
        """Return whether no more is needed. Raises BadRequest."""
        self._data += data
        while self._wanted and not self._over:
            if self._string is not None:
                ended = self._end_of_string()
                if ended is None:
                    return False
                key = bytes(self._data[self._string : ended])
                if self._is_key and self._depth == 1 and key in self._wanted:
                    if not self._value(key, ended):
                        return False
                    self._wanted.discard(key)
                self._string, self._is_key, self._at = None, False, ended
            found = _OUTSIDE.search(self._data, self._at)
            if found is None:
                self._data.clear()
                self._at = 0
                return False
            self._step(found[0], found.start())
        return True

    def _step(self, char: bytes, at: int) -> None:
        self._at = at + 1
        if char == b'"':
            self._string = at
            return
        if char in (b"{", b"["):
            self._depth += 1
            if self._depth > DEPTH_MAX:
                raise BadRequest(f"JSON nested deeper than {DEPTH_MAX} levels")
            self._is_key = self._depth == 1 and char == b"{"
        elif char in (b"}", b"]"):
            self._depth -= 1
            self._over = self._depth <= 0
        else:
            self._is_key = self._depth == 1

    def _end_of_string(self) -> int | None:
        """Return where the string ends that begins at `_string`; None: not here yet."""
        assert self._string is not None
        at = max(self._at, self._string + 1)
        while (found := _INSIDE.search(self._data, at)) is not None:
            if found[0] == b'"':
                return found.end()
            at = found.end() + 1  # what a backslash escapes
        # no key or name is that long: the beginning may go
        self._at = max(at, len(self._data))
        if len(self._data) - self._string > VALUE_MAX_BYTES:
            begin, self._string, self._is_key = self._string, 0, False
            over = self._at - len(self._data)
            del self._data[begin + 1 :]
            del self._data[:begin]
            self._at = len(self._data) + over
        return None

    def _value(self, key: bytes, ended: int) -> bool:
        """Read the value behind a key. Return whether it is here; else the key is looked at
        again."""
        found = _VALUE.match(self._data, ended)
        if found is None:
            if len(self._data) - ended > VALUE_MAX_BYTES:
                raise _wrong(key)
            self._at = ended - 1
            return False
        try:
            value = json.loads(found[1])
        except ValueError:
            raise _wrong(key) from None
        if key == STREAM:
            self.stream = value is True
        elif isinstance(value, str) and value:
            self.model = value
        else:
            raise _wrong(key)
        return True


def _wrong(key: bytes) -> BadRequest:
    hint = "see /v1/models"
    return BadRequest(f"`{key.decode().strip(chr(34))}` has a value that cannot be read", hint=hint)


class FormFinder:
    """Finds the field `model` of a form (RFC 7578)."""

    def __init__(self, boundary: bytes) -> None:
        self.model: str | None = None
        self.stream = False
        self._delimiter = b"\r\n--" + boundary
        self._data = bytearray(b"\r\n")  # the first delimiter has no line before it
        self._field = ""  # whose value it is in

    def feed(self, data: bytes) -> bool:
        """Return whether no more is needed. Raises BadRequest."""
        self._data += data
        while self.model is None:
            end = self._data.find(self._delimiter)
            if self._field == "model":
                if end < 0 and len(self._data) <= VALUE_MAX_BYTES + len(self._delimiter):
                    return False
                if not 2 < end <= VALUE_MAX_BYTES:
                    raise _wrong(MODEL)
                self.model = self._data[2:end].decode(errors="replace")
                break
            if end < 0:
                del self._data[: max(0, len(self._data) - len(self._delimiter) + 1)]
                return False
            begins = end + len(self._delimiter)
            if self._data[begins : begins + 2] == b"--":
                break
            head = self._data.find(b"\r\n\r\n", begins)
            if head < 0:
                if len(self._data) - end > _HEADERS_MAX_BYTES:
                    raise BadRequest("the headers of a part of the form are too long")
                del self._data[:end]
                return False
            self._field = _field_name(bytes(self._data[begins:head]))
            del self._data[: head + 2]  # an empty value's delimiter begins with this line's end
        return True


def _field_name(headers: bytes) -> str:
    """Return the name of a form's field, "" where there is none."""
    for line in headers.split(b"\r\n"):
        name, _, value = line.partition(b":")
        if name.strip().lower() == b"content-disposition":
            part = Message()
            part["content-disposition"] = value.strip().decode("latin-1")
            found = part.get_param("name", header="content-disposition")
            return found if isinstance(found, str) else ""
    return ""


def no_model() -> BadRequest:
    return BadRequest(
        "the body names no `model`",
        hint="name one of /v1/models, or call /upstream/NAME/…",
    )
