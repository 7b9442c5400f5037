"""Arguments that several commands share, and the types that check them."""

import argparse
import os
from collections.abc import Callable
from math import inf

from vram_arbiter.schemas.defaults import NAME_MAX_CHARS, REASON_MAX_CHARS
from vram_arbiter.schemas.runtime.endpoints import ENDPOINT_VARIABLE
from vram_arbiter.schemas.sizes import parse_need


def add_endpoint(parser: argparse.ArgumentParser) -> None:
    """Add `--endpoint`; `args.endpoint` is None where neither it nor the environment says one."""
    parser.add_argument(
        "--endpoint",
        default=os.environ.get(ENDPOINT_VARIABLE),
        help=f"socket of the arbiter (environment: {ENDPOINT_VARIABLE})",
    )


def add_json(parser: argparse.ArgumentParser) -> None:
    """Add `--json`."""
    parser.add_argument(
        "--json", dest="as_json", action="store_true", help="print the reply as JSON"
    )


def one_line(most: int, *, required: bool) -> Callable[[str], str]:
    """Return an argparse type: one line of at most `most` characters, as the wire takes it."""

    def check(written: str) -> str:
        if required and not written.strip():
            raise argparse.ArgumentTypeError("must not be empty")
        if len(written) > most or any(char < " " or char == "\x7f" for char in written):
            raise argparse.ArgumentTypeError(f"expected one line of at most {most} characters")
        return written

    return check


name = one_line(NAME_MAX_CHARS, required=True)
reason = one_line(REASON_MAX_CHARS, required=True)
remark = one_line(REASON_MAX_CHARS, required=False)


def size(written: str) -> int:
    """Argparse type: a byte size such as 5GiB."""
    try:
        return parse_need(written)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def at_least(low: float, high: float = inf) -> Callable[[str], float]:
    """Return an argparse type: a finite number from `low` to `high`."""
    return _number(float, low, high)


def count(low: int, high: float = inf) -> Callable[[str], int]:
    """Return an argparse type: a whole number from `low` to `high`."""
    return _number(int, low, high)


def positive(written: str) -> float:
    """Argparse type: a finite number above 0."""
    if not (value := at_least(0.0)(written)):
        raise argparse.ArgumentTypeError("expected a number above 0")
    return value


def _number[N: (int, float)](kind: type[N], low: float, high: float) -> Callable[[str], N]:
    def check(written: str) -> N:
        try:
            value = kind(written)
        except ValueError:
            value = kind(-1)
        if not low <= value <= high or value == inf:
            bound = f"at least {low:g}" if high == inf else f"{low:g} to {high:.9g}"
            whole = "whole " if kind is int else ""
            raise argparse.ArgumentTypeError(f"expected a {whole}number, {bound}, got {written!r}")
        return value

    return check
