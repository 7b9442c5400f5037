"""Reader of pickles as data: it imports nothing and calls nothing that a pickle names.

lerobot's robots send pickles, which `pickle.loads` would run as a program of the sender. This
reader performs the instructions that protocols 3 to 5 need for plain values, numpy's arrays and
torch's tensors on a stack of its own. A name that a pickle mentions is a word here: the caller's
table says what is made of it. Any other name or instruction is refused.

Cost is bounded by `OPCODES_MAX` and by the bytes of the pickle: an array is a view of bytes that
came, never larger. numpy's own limits on arrays are those of the sidecars' wire
(`clients.sidecar.npy`).
"""

import io
import pickletools
import re
from collections.abc import Callable, Mapping
from typing import Any, Final

from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.errors import BadRequest, LimitExceeded, VramError

OPCODES_MAX: Final = 2000
"""Instructions of one pickle, those of its tensors included: 5 ms of one core. An observation of
60 joints and 4 cameras has 500."""
_VALUES: Final = frozenset(
    {
        "BININT", "BININT1", "BININT2", "LONG1", "BINFLOAT", "SHORT_BINUNICODE", "BINUNICODE",
        "BINUNICODE8", "SHORT_BINBYTES", "BINBYTES", "BINBYTES8", "BYTEARRAY8",
    }
)  # fmt: skip
"""Instructions that push their argument."""
_MADE: Final[Mapping[str, Callable[[], Any]]] = {
    "NONE": lambda: None,
    "NEWTRUE": lambda: True,
    "NEWFALSE": lambda: False,
    "EMPTY_LIST": list,
    "EMPTY_DICT": dict,
    "EMPTY_TUPLE": tuple,
}
_TUPLES: Final = {"TUPLE1": 1, "TUPLE2": 2, "TUPLE3": 3}
_DTYPE: Final = re.compile(r"[<>|=]?[biuf][1248]")
_STORAGES: Final = {
    f"torch.{name}Storage": dtype
    for name, dtype in {
        "Float": "<f4", "Double": "<f8", "Half": "<f2", "Long": "<i8", "Int": "<i4",
        "Short": "<i2", "Char": "|i1", "Byte": "|u1", "Bool": "|b1",
    }.items()
}  # fmt: skip
_STORAGE_PICKLES: Final = 5
"""Of torch's older file format: a number, a version, the machine, the storage, its keys."""
_COUNT_BYTES: Final = 8
"""Behind them: the number of elements, which the fourth pickle has too."""


class Record:
    """One object of a class that the caller's table names, and its fields."""

    fields: Mapping[Any, Any] = {}

    def build(self, state: Any) -> None:
        self.fields = _of(dict, state)


class Array:
    """An array: numpy's in `numbers` once it is complete."""

    def __init__(self, numbers: Any = None) -> None:
        self.numbers = numbers

    def build(self, state: Any) -> None:
        _, shape, dtype, fortran, data = state
        self.numbers = _array(data, dtype, shape, "F" if fortran else "C").numbers


class _Dtype(str):
    """A type of numbers, in numpy's words."""

    def __new__(cls, text: str, *_: Any) -> "_Dtype":
        if not _DTYPE.fullmatch(text):
            raise ValueError(f"an array of type {text[:20]!r}, not of numbers")
        return super().__new__(cls, text)

    def build(self, state: Any) -> None:
        if state[1] not in ("<", "|"):
            raise ValueError(f"numbers whose bytes are in the order {state[1]!r}")


def _array(data: Any, dtype: Any, shape: Any, order: Any) -> Array:
    import numpy

    known: Any = numpy.dtype(str(_of(_Dtype, dtype)))
    flat = npy.flat(bytes(_of((bytes, bytearray), data)), known, tuple(shape))
    return Array(flat.reshape(shape, order="F" if order == "F" else "C"))


def _blank(*_: Any) -> Array:
    """Return an array that its state completes."""
    return Array()


def _scalar(dtype: Any, data: Any) -> Any:
    return _array(data, dtype, (1,), "C").numbers[0].item()


def _tensor(storage: Any, offset: Any, shape: Any, strides: Any, *_: Any) -> Array:
    """Return a tensor of the elements of `storage` from `offset` on; strides count elements."""
    import numpy

    numbers = _of(Array, storage).numbers
    step = numbers.dtype.itemsize
    view: Any = numpy.ndarray(
        tuple(shape), numbers.dtype, numbers, offset * step, tuple(one * step for one in strides)
    )
    if view.nbytes > numbers.nbytes:  # a stride of 0 makes much of little
        raise ValueError(f"a tensor of {view.nbytes} bytes in a storage of {numbers.nbytes}")
    return Array(view)


NAMES: Final[Mapping[str, Callable[..., Any]]] = {
    "numpy.dtype": _Dtype,
    "numpy.ndarray": Array,
    "torch._utils._rebuild_tensor_v2": _tensor,
    "torch.storage._load_from_bytes": Array,  # replaced by the reader: it counts on
    "collections.OrderedDict": dict,
    **dict.fromkeys(_STORAGES, Array),
    **{
        f"numpy.{core}.{name}": make
        for core in ("core", "_core")  # before and from numpy 2 on
        for name, make in {
            "multiarray._reconstruct": _blank,
            "multiarray.scalar": _scalar,
            "numeric._frombuffer": _array,
        }.items()
    },
}
"""What a pickle of numbers may name, and what is made of it."""


class _Name(str):
    """A class or function that a pickle mentions."""


_MARK: Final = object()


def read(data: bytes, names: Mapping[str, Callable[..., Any]]) -> Any:
    """Return the value of a pickle. Of what it names, `names` and `NAMES` make something.

    Raises: BadRequest for any other name or instruction, and for bytes that are no pickle;
    LimitExceeded for more than `OPCODES_MAX` instructions.
    """
    reader = _Reader({**NAMES, **names})
    try:
        return reader.read(io.BytesIO(data))
    except VramError:
        raise
    except (ValueError, TypeError, LookupError, ArithmeticError, MemoryError) as error:
        raise BadRequest(
            f"not a pickle that is read here: {str(error)[:200] or type(error).__name__}",
            hint="send what lerobot's robot_client sends",
        ) from None


class _Reader:
    def __init__(self, names: Mapping[str, Callable[..., Any]]) -> None:
        self._names = {**names, "torch.storage._load_from_bytes": self._storage}
        self._left = OPCODES_MAX

    def read(self, stream: io.BytesIO) -> Any:
        """Return the value of the next pickle in `stream`."""
        stack: list[Any] = []
        memo: dict[int, Any] = {}
        for opcode, argument, _ in pickletools.genops(stream):
            self._left -= 1
            if self._left < 0:
                raise LimitExceeded(
                    f"a pickle of more than {OPCODES_MAX} instructions",
                    hint="send arrays, not lists of numbers",
                )
            self._perform(opcode.name, argument, stack, memo)
        (value,) = stack
        return value

    def _perform(self, name: str, argument: Any, stack: list[Any], memo: dict[int, Any]) -> None:
        if name in _VALUES:
            stack.append(argument)
        elif name in _MADE:
            stack.append(_MADE[name]())
        elif name in _TUPLES:
            stack.append(tuple(_last(stack, _TUPLES[name])))
        else:
            match name:
                case "PROTO" | "FRAME" | "STOP":
                    pass
                case "MARK":
                    stack.append(_MARK)
                case "TUPLE":
                    stack.append(tuple(_since_mark(stack)))
                case "APPEND" | "APPENDS":
                    items = _last(stack, 1) if name == "APPEND" else _since_mark(stack)
                    _of(list, stack[-1]).extend(items)
                case "SETITEM" | "SETITEMS":
                    items = _last(stack, 2) if name == "SETITEM" else _since_mark(stack)
                    _of(dict, stack[-1]).update(zip(items[::2], items[1::2], strict=True))
                case "MEMOIZE":
                    memo[len(memo)] = stack[-1]
                case "BINPUT" | "LONG_BINPUT":
                    memo[argument] = stack[-1]
                case "BINGET" | "LONG_BINGET":
                    stack.append(memo[argument])
                case "GLOBAL":
                    stack.append(self._named(argument.replace(" ", ".")))
                case "STACK_GLOBAL":
                    stack.append(self._named(".".join(_of(str, one) for one in _last(stack, 2))))
                case "REDUCE" | "NEWOBJ":
                    called, arguments = _last(stack, 2)
                    stack.append(self._names[_of(_Name, called)](*_of(tuple, arguments)))
                case "BUILD":
                    (state,) = _last(stack, 1)
                    _of((Record, Array, _Dtype), stack[-1]).build(state)
                case "BINPERSID":
                    stack.append(_stored(*_last(stack, 1)))
                case _:
                    raise ValueError(f"the instruction {name}")

    def _named(self, text: str) -> _Name:
        if text not in self._names:
            raise BadRequest(
                f"a pickle that names {text[:100]!r}, which is not of this protocol",
                hint="nothing was loaded or run; send what lerobot's robot_client sends",
            )
        return _Name(text)

    def _storage(self, data: Any) -> Array:
        """Return what `torch.save` wrote of a storage, in its older format."""
        stream = io.BytesIO(_of(bytes, data))
        dtype, count = [self.read(stream) for _ in range(_STORAGE_PICKLES)][3]
        behind = stream.read()[_COUNT_BYTES:]
        return _array(behind, _Dtype(dtype), (count,), "C")


def _stored(identity: Any) -> tuple[str, int]:
    """Return type and number of elements of a storage that a pickle refers to."""
    kind, storage, _, _, count, _ = identity
    if kind != "storage":
        raise ValueError("a reference to something else than a storage")
    return _STORAGES[storage], _of(int, count)


def _last(stack: list[Any], count: int) -> list[Any]:
    """Take the last `count` values off the stack."""
    if len(stack) < count or any(one is _MARK for one in stack[-count:]):
        raise ValueError("values that are missing")
    taken = stack[-count:]
    del stack[-count:]
    return taken


def _since_mark(stack: list[Any]) -> list[Any]:
    """Take the values behind the last mark off the stack, and the mark."""
    place = len(stack) - 1
    while stack[place] is not _MARK:
        place -= 1
        if place < 0:
            raise ValueError("a mark that is missing")
    taken = stack[place + 1 :]
    del stack[place:]
    return taken


def _of[T](kind: type[T] | tuple[type, ...], value: Any) -> Any:
    """Return a value of this kind. Raises ValueError."""
    if not isinstance(value, kind):
        raise ValueError(f"a {type(value).__name__} where it cannot stand")
    return value
