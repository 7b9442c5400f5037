"""Coverage-guided fuzzing of the bounded msgpack decoder with atheris: `python
tests/fuzz/fuzz_msgpack.py -runs=10000000 [CORPUS]`.

atheris is not a dependency of this project: `pip install atheris` into an environment of its own.
Ends with libFuzzer's report; a finding is an input that raises anything but the typed errors, or of
which more values are built than were counted or are allowed.
"""

import sys
import tempfile
from pathlib import Path

import atheris
import msgpack

with atheris.instrument_imports(include=["vram_arbiter.schemas.runtime.msgpack_codec"]):
    from tests.support.hostile import BOMBS
    from vram_arbiter.schemas.errors import BadFrame, MessageTooLarge
    from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, count_values, unpack_map

LIMITS = UnpackLimits(
    message_max_bytes=2048, values_max=32, keys_max=8, items_max=16, beside_binary_max_bytes=512
)
"""Limits that short inputs reach."""
SEED_MAX_BYTES = 1000


def values_in(value: object) -> int:
    if isinstance(value, dict):
        return 1 + sum(values_in(key) + values_in(held) for key, held in value.items())
    return 1 + sum(map(values_in, value)) if isinstance(value, list) else 1


def try_msgpack(frame: bytes) -> None:
    """What is built is never more than was counted and allowed; fewer where a key stands twice."""
    try:
        built = values_in(unpack_map(frame, LIMITS))
    except (BadFrame, MessageTooLarge):
        return
    if not built <= count_values(frame, len(frame)) <= max(LIMITS.values_max, len(frame)):
        raise AssertionError(f"{frame[:64]!r} holds {built} values and was counted otherwise")
    if len(frame) > LIMITS.values_max and built > LIMITS.values_max:
        raise AssertionError(f"{frame[:64]!r} holds {built} values")


def write_corpus(folder: Path) -> None:
    """Every form of a length, and the small bombs."""
    values = [
        0,
        -1,
        1 << 40,
        1.5,
        None,
        True,
        "text" * 10,
        "x" * 300,
        b"bin",
        bytes(300),
        [0] * 20,
        {"k": [1, {"l": 2}]},
    ]
    seeds = [msgpack.packb({"op": value}) for value in values]
    seeds += [bomb for bomb in BOMBS.values() if len(bomb) < SEED_MAX_BYTES]
    for number, seed in enumerate(seeds):
        (folder / f"seed-{number}").write_bytes(seed)


def main() -> None:
    arguments = list(sys.argv)
    with tempfile.TemporaryDirectory(prefix="corpus") as folder:
        if all(argument.startswith("-") for argument in arguments[1:]):
            write_corpus(Path(folder))
            arguments.append(folder)
        atheris.Setup(arguments, try_msgpack)
        atheris.Fuzz()


if __name__ == "__main__":
    main()
