"""Turns: a fair order of waiting items over nested keys."""

from collections import OrderedDict
from collections.abc import Hashable, Sequence
from typing import Any


class Turns[T: Hashable]:
    """Items that wait for a turn, each under a path of keys such as (user, process).

    Every key of a level has its turn before the first has its second: a user with a thousand busy
    connections delays another user's only one by one item, not by a thousand. `add`, `pop` and
    `discard` take time in the path's length.
    """

    def __init__(self) -> None:
        self._root: OrderedDict[Any, Any] = OrderedDict()
        self._paths: dict[T, Sequence[Hashable]] = {}

    def __len__(self) -> int:
        return len(self._paths)

    def __contains__(self, item: T) -> bool:
        return item in self._paths

    def add(self, item: T, path: Sequence[Hashable]) -> None:
        """Let `item` wait, behind the others of its path. Nothing changes if it waits already."""
        if item in self._paths:
            return
        self._paths[item] = path
        ring = self._root
        for key in path:
            ring = ring.setdefault(key, OrderedDict())
        ring[item] = None

    def pop(self) -> T:
        """Return the item whose turn it is; its keys go to the end of their rings. Raises KeyError
        where none waits.
        """
        depth, ring = 0, self._root
        while True:
            key = next(iter(ring), None)
            if key is None:
                raise KeyError("no item waits")
            if key in self._paths and depth == len(self._paths[key]):
                break
            depth += 1
            ring = ring[key]
        self._remove(key, rotate=True)
        item: T = key
        return item

    def discard(self, item: T) -> None:
        """Let `item` wait no longer, if it does."""
        if item in self._paths:
            self._remove(item, rotate=False)

    def _remove(self, item: T, *, rotate: bool) -> None:
        path = self._paths.pop(item)
        rings = [self._root]
        for key in path:
            rings.append(rings[-1][key])
        del rings[-1][item]
        for ring, key in zip(reversed(rings[:-1]), reversed(path), strict=True):
            if not ring[key]:
                del ring[key]
            elif rotate:
                ring.move_to_end(key)
