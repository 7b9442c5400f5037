"""Copies of a world, thousands a second.

A copy is a pickle in which whatever never changes (frozen records, named tuples, enumerations,
code) is a reference to the one object that all copies share. Closures, which the client's protocol
keeps for its replies, travel as their code and their cells, so that a copy's closures speak of the
copy.
"""

import importlib
import io
import itertools
import pickle
from collections.abc import Callable
from enum import Enum
from functools import cache
from types import CellType, CodeType, FunctionType
from typing import Any

type Frozen = tuple[bytes, list[object]]
"""The pickle of a world, and the objects that it refers to."""

_shared: list[object] = []
"""Those of the copy that is made or read at the moment."""


def freeze(world: object) -> Frozen:
    """Return a copy that `thaw` brings to life, any number of times."""
    shared: list[object] = []
    buffer = io.BytesIO()
    _Pickler(buffer, shared).dump(world)
    return buffer.getvalue(), shared


def thaw(frozen: Frozen) -> Any:
    """Return a fresh copy of what was frozen."""
    global _shared
    data, _shared = frozen
    return pickle.loads(data)


class _Pickler(pickle.Pickler):
    def __init__(self, buffer: io.BytesIO, shared: list[object]) -> None:
        super().__init__(buffer, 5)
        self._shared = shared

    def reducer_override(self, value: Any) -> Any:
        kind: type = type(value)
        reduce = _reducer(kind)
        if reduce is not _refer:
            return NotImplemented if reduce is None else reduce(value)
        self._shared.append(value)
        return _referred, (len(self._shared) - 1,)


@cache
def _reducer(kind: type) -> Callable[[Any], Any] | None:
    """Return how objects of a class are pickled; None: as ever."""
    parameters = getattr(kind, "__dataclass_params__", None)
    if (parameters is not None and parameters.frozen) or issubclass(kind, _UNCHANGING):
        return _refer
    return _OTHERS.get(kind)


def _refer(value: object) -> object:
    """Stands for: all copies share it."""
    return value


def _referred(index: int) -> object:
    return _shared[index]


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


def _reduce_count(numbers: "itertools.count[int]") -> Any:
    return itertools.count, (int(repr(numbers)[len("count(") : -1]),)


_UNCHANGING = (Enum, CodeType, tuple)  # a tuple of a class of its own is a named one
_OTHERS: dict[type, Callable[[Any], Any]] = {
    FunctionType: _reduce_function,
    CellType: _reduce_cell,
    itertools.count: _reduce_count,
}
