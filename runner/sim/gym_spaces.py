"""gymnasium's spaces as rows of named numbers.

Covers actions and observations of Box, Discrete, MultiDiscrete and MultiBinary parts, nested in
Dict and Tuple at any depth. Must not know environments or the runner.

A part's numbers are named by its path, dots between keys and indices: `gripper` for one number,
`arm.0`, `arm.1` … for more, those of a Box of several dimensions row by row. As an action a Box is
its own numbers (whole ones rounded), a Discrete of n one number, [-1, 1] cut into n equal parts, a
MultiDiscrete such a number per axis, and a MultiBinary (or a Box of truth values) 0 to 1 per bit,
set from 0.5 on. As an observation every part is its own numbers.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Final

CHOICES_MAX: Final = (
    2**40
)  # beyond it the parts of [-1, 1] are hardly more than a float's own steps
BIT_FROM: Final = 0.5

Keys = tuple[Any, ...]


class NoNumbers(Exception):
    """This space or value is not a row of numbers; the message tells why."""


@dataclass(frozen=True, slots=True)
class Leaf:
    """A part that is neither a Dict nor a Tuple, and the keys and indices that lead to it."""

    keys: Keys
    space: Any

    @property
    def path(self) -> str:
        return ".".join(map(str, self.keys))

    @property
    def size(self) -> int:
        """How many numbers it is. Raises NoNumbers for a part that is none."""
        from gymnasium import spaces

        match self.space:
            case spaces.Discrete():
                return 1
            case spaces.Box() | spaces.MultiDiscrete() | spaces.MultiBinary():
                return math.prod(self.space.shape)
        raise NoNumbers(f"{self.path or 'it'} is {self.space}: {_why_not(self.space)}")

    @property
    def picture(self) -> bool:
        """Whether it is one that a camera could have taken: uint8, height × width × 3."""
        return self.bytes_in_a_plane and self.space.shape[2:] == (3,)

    @property
    def bytes_in_a_plane(self) -> bool:
        """Return whether it is a picture of any kind: of one color, or several stacked."""
        from gymnasium import spaces

        space = self.space
        return (
            isinstance(space, spaces.Box) and space.dtype.name == "uint8" and len(space.shape) > 1
        )

    def names(self, otherwise: str) -> list[str]:
        """Return the names of its numbers; `otherwise` replaces the path of a space without
        parts.
        """
        path, size = self.path or otherwise, self.size
        return [path] if size == 1 else [f"{path}.{index}" for index in range(size)]

    def of(self, whole: Any) -> Any:
        """This part of a value. Raises NoNumbers where it has none."""
        try:
            for key in self.keys:
                whole = whole[key]
        except (KeyError, IndexError, TypeError) as error:
            raise NoNumbers(f"it has no {self.path}") from error
        return whole

    def numbers(self, whole: Any) -> list[float]:
        """Return this part's numbers as they are.

        Raises NoNumbers for others than the space describes.
        """
        import numpy as np

        part = self.of(whole)
        try:
            values = np.asarray(part, dtype=float).reshape(-1).tolist()
        except (TypeError, ValueError) as error:
            raise NoNumbers(f"{self.path or 'it'} is not made of numbers: {error}") from error
        if len(values) != self.size:
            raise NoNumbers(
                f"{self.path or 'it'} has {len(values)} numbers, {self.size} were promised"
            )
        return [float(value) for value in values]


def _why_not(space: Any) -> str:
    from gymnasium import spaces

    match space:
        case spaces.Text():
            return "a text is not a number"
        case spaces.Sequence():
            return "a sequence is longer one time than another"
        case spaces.Graph():
            return "a graph has more nodes one time than another"
        case spaces.OneOf():
            return "which of its alternatives it is decides how many numbers it has"
    return "none of gymnasium's spaces of numbers"


def leaves(space: Any, keys: Keys = ()) -> Iterator[Leaf]:
    """Return all parts in the space's own order (gymnasium sorts the keys of a Dict by default)."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        for key, part in space.spaces.items():
            yield from leaves(part, (*keys, key))
    elif isinstance(space, spaces.Tuple):
        for index, part in enumerate(space.spaces):
            yield from leaves(part, (*keys, index))
    else:
        yield Leaf(keys, space)


# -- actions
class ActionRow:
    """An action space as a row. `names`, `low` and `high` in the row's order.

    `element(row)` is in the space for every row of finite numbers, with excess clamped to the
    limits; `element(row_of(x))` is x. Raises NoNumbers for a space that is not such a row.
    """

    def __init__(self, space: Any) -> None:
        self.space = space
        self._leaves = tuple(leaves(space))
        limits = [limit for leaf in self._leaves for limit in _limits(leaf)]
        self.names = tuple(name for leaf in self._leaves for name in leaf.names("action"))
        self.low = tuple(low for low, _ in limits)
        self.high = tuple(high for _, high in limits)
        if not limits:
            raise NoNumbers("there is nothing in it to decide")
        if len(set(self.names)) != len(self.names):
            raise NoNumbers(f"several of its numbers have the same name: {', '.join(self.names)}")

    def row_of(self, element: Any) -> list[float]:
        """Return the row of what the space itself takes; a Box's numbers may be beyond its limits.

        Raises NoNumbers for anything else.
        """
        _check_keys(self.space, element, "it")
        return [number for leaf in self._leaves for number in _row_of(leaf, element)]

    def element(self, row: Sequence[float]) -> Any:
        """Return what the space takes of a row of as many numbers as it has names."""
        numbers = iter(row)
        return _element(self.space, numbers)


def _bounds(box: Any) -> list[tuple[Any, Any]]:
    """Return low and high of every number of a Box; without limits, those of its dtype."""
    import numpy as np

    low, high = box.low.reshape(-1), box.high.reshape(-1)
    if box.dtype.kind == "f":
        largest = np.finfo(box.dtype).max
        low, high = low.clip(-largest, largest), high.clip(-largest, largest)
    return list(zip(low.tolist(), high.tolist(), strict=True))


def _limits(leaf: Leaf) -> list[tuple[float, float]]:
    """Return the limits of every number."""
    from gymnasium import spaces

    size, space = leaf.size, leaf.space
    match space:
        case spaces.Discrete():
            far = [abs(int(space.start)) + int(space.n)]
        case spaces.MultiDiscrete():
            far = [
                abs(int(at)) + int(n)
                for at, n in zip(space.start.flat, space.nvec.flat, strict=True)
            ]
        case spaces.MultiBinary():
            return [(0.0, 1.0)] * size
        case spaces.Box():
            return [(float(low), float(high)) for low, high in _bounds(space)]
    if max(far, default=0) > CHOICES_MAX:
        raise NoNumbers(
            f"{leaf.path or 'it'} is {space}: such choices cannot be told apart as floats"
        )
    return [(-1.0, 1.0)] * size


def _check_keys(space: Any, element: Any, where: str) -> None:
    """Raise NoNumbers for an action that lacks a part, or has one too many."""
    from gymnasium import spaces

    if isinstance(space, spaces.Dict):
        if not isinstance(element, Mapping) or set(element) != set(space.spaces):
            raise NoNumbers(
                f"{where} must have exactly the keys {', '.join(map(str, space.spaces))}"
            )
        for key, part in space.spaces.items():
            _check_keys(part, element[key], str(key))
    elif isinstance(space, spaces.Tuple):
        if not isinstance(element, list | tuple) or len(element) != len(space.spaces):
            raise NoNumbers(f"{where} must have {len(space.spaces)} parts")
        for index, part in enumerate(space.spaces):
            _check_keys(part, element[index], str(index))


def _row_of(leaf: Leaf, element: Any) -> list[float]:
    from gymnasium import spaces

    space, values = leaf.space, leaf.numbers(element)
    if not all(map(math.isfinite, values)):
        raise NoNumbers(f"its numbers are not finite: {values}")
    match space:
        case spaces.Discrete():
            return [_middle(leaf, values[0], int(space.start), int(space.n))]
        case spaces.MultiDiscrete():
            axes = zip(values, space.start.flat, space.nvec.flat, strict=True)
            return [_middle(leaf, value, int(start), int(n)) for value, start, n in axes]
        case spaces.MultiBinary():
            return [_bit(leaf, value) for value in values]
    return [_bit(leaf, value) for value in values] if space.dtype.kind == "b" else values


def _middle(leaf: Leaf, value: float, start: int, n: int) -> float:
    """Return the middle of a choice's share of [-1, 1]."""
    if not value.is_integer() or not start <= int(value) < start + n:
        raise NoNumbers(
            f"{value:g} is not a choice of {leaf.path or leaf.space}: {start} to {start + n - 1}"
        )
    return -1 + (2 * (int(value) - start) + 1) / n


def _bit(leaf: Leaf, value: float) -> float:
    if value not in (0.0, 1.0):
        raise NoNumbers(f"{value:g} is not a bit of {leaf.path or leaf.space}")
    return value


def _chosen(number: float, start: int, n: int) -> int:
    return start + min(math.floor((min(max(number, -1.0), 1.0) + 1) / 2 * n), n - 1)


def _element(space: Any, numbers: Iterator[float]) -> Any:
    """Takes as many of the numbers as the space has."""
    import numpy as np
    from gymnasium import spaces

    match space:
        case spaces.Dict():
            return {key: _element(part, numbers) for key, part in space.spaces.items()}
        case spaces.Tuple():
            return tuple(_element(part, numbers) for part in space.spaces)
        case spaces.Discrete():
            return _chosen(next(numbers), int(space.start), int(space.n))
        case spaces.MultiDiscrete():
            axes = zip(space.start.flat, space.nvec.flat, strict=True)
            chosen = [_chosen(next(numbers), int(start), int(n)) for start, n in axes]
            return np.array(chosen, dtype=space.dtype).reshape(space.shape)
        case spaces.MultiBinary():
            bits = [next(numbers) >= BIT_FROM for _ in range(math.prod(space.shape))]
            return np.array(bits, dtype=space.dtype).reshape(space.shape)
    taken = [_within(next(numbers), low, high, space.dtype.kind) for low, high in _bounds(space)]
    return np.array(taken, dtype=space.dtype).reshape(space.shape)


def _within(number: float, low: Any, high: Any, kind: str) -> Any:
    """Convert a Box's number. Whole numbers are compared as such: 2^63 - 1 is not a float."""
    if kind == "f":
        return min(max(number, low), high)
    whole = int(number >= BIT_FROM) if kind == "b" else round(number)
    return min(max(whole, low), high)
