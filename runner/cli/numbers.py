"""Types of the numbers in command lines."""

import argparse
from collections.abc import Callable
from math import inf


def _number[N: (int, float)](
    kind: Callable[[str], N], wanted: Callable[[N], bool], said: str
) -> Callable[[str], N]:
    """Return the parser of a flag whose number is `said`."""

    def number(text: str) -> N:
        value = kind(text)
        if not wanted(value):
            raise argparse.ArgumentTypeError(f"{text} is not {said}")
        return value

    return number


positive = _number(float, lambda value: 0 < value < inf, "positive")
not_negative = _number(float, lambda value: 0 <= value < inf, "0 or more")
positive_int = _number(int, lambda value: value >= 1, "1 or more")
not_negative_int = _number(int, lambda value: value >= 0, "0 or more")
