"""Copies of a world, thousands a second.

A copy is a pickle in which whatever never changes (frozen records, named tuples, enumerations,
code) is a reference to the one object that all copies share. What most worlds have of it, with the
classes and the names of their fields, is in the memo of each pickle before it begins (`_Words`).
Closures, which the client's protocol keeps for its replies, travel as their code and their cells,
so that a copy's closures speak of the copy.
"""

import io
import pickle
import sys
from enum import Enum
from functools import cache
from itertools import count
from types import CellType, CodeType, FunctionType
from typing import Any

from tests.explore.world import World

type Frozen = tuple[bytes, list[object], _Words]
"""The pickle of a world, the objects that it refers to, and the words that it is written in."""

_shared: list[object] = []
"""Those of the copy that is made or read at the moment."""


class _Words:
    """Objects that a pickle refers to by their numbers in a memo; numbers in it begin after them,
    so it is read with the words that it was written in."""

    def __init__(self, words: list[object]) -> None:
        self.words = words
        buffer = io.BytesIO()
        _shared.clear()
        self.written = _Pickler(buffer, 3)
        self.written.dump(words)
        self.read = pickle.Unpickler(io.BytesIO(buffer.getvalue()))
        self.read.load()


class Freezer:
    """Makes copies, with words that it learns from the worlds that it meets."""

    def __init__(self) -> None:
        self._words, self._count = _Words([_recall, _function, _cell]), 0

    def freeze(self, world: World) -> Frozen:
        """Return a copy of a world."""
        _shared.clear()
        buffer, words = io.BytesIO(), self._words
        pickler = _Pickler(buffer, 3)
        pickler.memo = words.written.memo
        pickler.dump(world)
        data = buffer.getvalue()
        frame = pickle.FRAME + len(data).to_bytes(8, "little")  # read at once
        frozen = frame + data, _shared.copy(), words
        self._count += 1
        if self._count.bit_count() == 1:  # ever more rarely
            known = set(map(id, words.words))
            met = [thing for _, thing in pickler.memo.copy().values() if id(thing) not in known]
            self._words = _Words(words.words + list(filter(_is_word, met)))
        return frozen


def thaw(frozen: Frozen) -> World:
    """Return the world that was frozen."""
    data, _shared[:], words = frozen
    unpickler = pickle.Unpickler(io.BytesIO(data))
    unpickler.memo = words.read.memo
    world = unpickler.load()
    assert isinstance(world, World)
    return world


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        kind: type = type(value)
        if _never_changes(kind):
            _shared.append(value)
            return _recall, (len(_shared) - 1,)
        if kind is FunctionType and value.__closure__ is not None:
            return _function, (value.__code__, value.__module__, value.__closure__)
        if kind is CellType:
            return _cell, (value.cell_contents,)
        if kind is count:
            return count, (int(repr(value)[len("count(") : -1]),)
        return NotImplemented


@cache
def _never_changes(kind: type) -> bool:
    """Whether all copies share the objects of a class. A tuple of a class of its own is a named
    one."""
    parameters = getattr(kind, "__dataclass_params__", None)
    named = issubclass(kind, tuple) and kind is not tuple
    return named or issubclass(kind, Enum | CodeType) or getattr(parameters, "frozen", False)


def _is_word(thing: Any) -> bool:
    kind: type = type(thing)
    return isinstance(thing, str | type) or _never_changes(kind)


def _recall(n: int) -> object:
    return _shared[n]


def _function(code: CodeType, module: str, cells: tuple[CellType, ...]) -> FunctionType:
    return FunctionType(code, vars(sys.modules[module]), closure=cells)


def _cell(contents: object) -> CellType:
    return CellType(contents)
