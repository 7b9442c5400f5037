"""Copies of a world, thousands a second.

A copy is a pickle in which whatever never changes (frozen records, named tuples, enumerations,
code) is a reference to the one object that all copies share. What most worlds have of it, with the
classes and the names of their fields, is in the memo of each pickle before it begins (`_Words`).
Closures, which the client's protocol keeps for its replies, travel as their code and their cells,
so that a copy's closures speak of the copy.
"""

import importlib
import io
import itertools
import pickle
from collections import Counter, deque
from collections.abc import Callable
from enum import Enum
from functools import cache
from operator import getitem
from types import CellType, CodeType, FunctionType
from typing import Any

from tests.explore.world import World

type Parts = dict[str, Frozen]
type Frozen = tuple[bytes, list[object], _Words]
"""The pickle of a world, the objects that it refers to, and the words that it is written in."""

_shared: list[object] = []
"""Those of the copy that is made or read at the moment."""


class _Words:
    """Objects that a pickle refers to without naming them. A pickle is read with the words that it
    was written in: the numbers in it begin after them."""

    def __init__(self, words: list[object]) -> None:
        self.words = words
        self.written, self.read = pickle.Pickler(io.BytesIO()), _Reader(io.BytesIO(_primer(words)))
        self.written.memo = {id(word): (n, word) for n, word in enumerate(words)}
        self.read.words = words
        self.read.load()

    def with_those_of(self, pickler: pickle.Pickler) -> "_Words":
        """Return these words and those that a pickle had to add."""
        met = sorted(pickler.memo.copy().values(), key=lambda entry: entry[0])
        return _Words(
            self.words + [thing for n, thing in met[len(self.words) :] if _is_word(thing)]
        )


class _Reader(pickle.Unpickler):
    words: list[object]

    def persistent_load(self, n: int) -> object:
        return self.words[n]


def _primer(words: list[object]) -> bytes:
    """Return a pickle that puts words into a reader's memo: a dictionary is not taken there."""
    numbers = [n.to_bytes(4, "little") for n in range(len(words))]
    puts = [pickle.BININT + n + pickle.BINPERSID + pickle.LONG_BINPUT + n for n in numbers]
    return pickle.POP.join(puts) + pickle.STOP


class Freezer:
    """Makes copies, with words that it learns from the parts that it meets."""

    def __init__(self) -> None:
        self._words: dict[str, _Words] = {}
        self._count: Counter[str] = Counter()

    def freeze(self, world: World, before: Parts) -> Parts:
        """Return a copy of a world that began as `before` (empty: it is new) and was touched."""
        parts = world.parts()
        touched = world.touched if before else parts
        return before | {name: self._freeze(name, parts[name]) for name in touched}

    def _freeze(self, name: str, part: object) -> Frozen:
        _shared.clear()
        buffer = io.BytesIO()
        pickler, words = _Pickler(buffer, 3), self._words.get(name) or _Words([_shared, getitem])
        pickler.memo = words.written.memo
        pickler.dump(part)
        data = buffer.getvalue()
        frame = pickle.FRAME + len(data).to_bytes(8, "little")  # read at once
        frozen = frame + data, _shared.copy(), words
        self._count[name] += 1
        if self._count[name].bit_count() == 1:  # ever more rarely
            self._words[name] = words.with_those_of(pickler)
        return frozen


def thaw(parts: Parts, world: World) -> World:
    """Bring a world to what was frozen. What it is in already, untouched, stays."""
    for name, frozen in parts.items():
        if name in world.touched or world.origin.get(name) is not frozen:
            world.put_back(name, _thaw(frozen))
    world.origin, world.touched = parts, set()
    return world


def _thaw(frozen: Frozen) -> Any:
    data, _shared[:], words = frozen
    unpickler = pickle.Unpickler(io.BytesIO(data))
    unpickler.memo = words.read.memo
    return unpickler.load()


class _Pickler(pickle.Pickler):
    def reducer_override(self, value: Any) -> Any:
        kind: type = type(value)
        reduce = _reducer(kind)
        return NotImplemented if reduce is None else reduce(value)


@cache
def _reducer(kind: type) -> Callable[[Any], Any] | None:
    """Return how objects of a class are pickled; None: as ever."""
    parameters = getattr(kind, "__dataclass_params__", None)
    if (parameters is not None and parameters.frozen) or issubclass(kind, _UNCHANGING):
        return _refer
    return _OTHERS.get(kind)


def _refer(value: object) -> Any:
    """All copies share it."""
    _shared.append(value)
    return getitem, (_shared, len(_shared) - 1)


def _is_word(thing: object) -> bool:
    kind: type = type(thing)
    return isinstance(thing, str | type) or (_reducer(kind) is _refer and kind is not tuple)


# -- what pickle cannot do by itself
def _reduce_function(function: FunctionType) -> Any:
    if function.__closure__ is None:
        return NotImplemented
    return _function, (function.__code__, function.__module__, function.__closure__)


def _function(code: CodeType, module: str, cells: tuple[CellType, ...]) -> FunctionType:
    names = vars(importlib.import_module(module))
    return FunctionType(code, names, code.co_name, None, cells)


def _reduce_cell(cell: CellType) -> Any:
    return _cell, (), (cell.cell_contents,), None, None, _fill


def _cell() -> CellType:
    return CellType()


def _fill(cell: CellType, contents: tuple[object]) -> None:
    (cell.cell_contents,) = contents


def _reduce_deque(some: deque[Any]) -> Any:
    return deque, (list(some), some.maxlen)


def _reduce_count(numbers: "itertools.count[int]") -> Any:
    return itertools.count, (int(repr(numbers)[len("count(") : -1]),)


_UNCHANGING = (Enum, CodeType, tuple)  # a tuple of a class of its own is a named one
_OTHERS: dict[type, Callable[[Any], Any]] = {
    FunctionType: _reduce_function,
    CellType: _reduce_cell,
    deque: _reduce_deque,
    itertools.count: _reduce_count,
}
