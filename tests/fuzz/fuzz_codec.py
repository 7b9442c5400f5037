"""Coverage-guided fuzzing of the codec with atheris: `python tests/fuzz/fuzz_codec.py
-max_total_time=300 [CORPUS]`.

atheris is no dependency of this project: `pip install atheris` into an environment of its own. Ends
with libFuzzer's report; a crash is a frame that made `decode` raise anything but `Undecodable`, or
an answer that cannot be sent or is long. `fuzz_msgpack.py` is the decoder below it.
"""

import random
import sys
import tempfile
from pathlib import Path

import atheris

with atheris.instrument_imports(
    include=[
        "vram_arbiter.arbiter.rpc.codec",
        "vram_arbiter.schemas.runtime.msgpack_codec",
        "vram_arbiter.schemas.wire.requests",
        "vram_arbiter.schemas.errors",
        "msgpack",
    ]
):
    from tests.support.hostile import BOMBS, Forger, pack
    from vram_arbiter.arbiter.rpc import codec
    from vram_arbiter.schemas.defaults import MESSAGE_MAX_BYTES
    from vram_arbiter.schemas.wire.requests import REQUESTS

ANSWER_MAX_BYTES = 16_384
SEEDS_PER_OP = 4


def try_codec(frame: bytes) -> None:
    """One execution: the frame as it is, and the mutant that its bytes choose."""
    for tried in (frame, Forger(random.Random(frame)).frame()):
        try:
            codec.decode(tried, MESSAGE_MAX_BYTES)
        except codec.Undecodable as bad:
            if len(codec.refusal(bad.request_id, 1, bad.error.view())) > ANSWER_MAX_BYTES:
                raise AssertionError(f"the answer to {tried[:64]!r} is long") from bad


def write_corpus(folder: Path) -> None:
    """Requests of every op and the small bombs: what libFuzzer starts from."""
    for op in REQUESTS:
        for number in range(SEEDS_PER_OP):
            (folder / f"{op}-{number}").write_bytes(pack(Forger(random.Random(number)).request(op)))
    for number, bomb in enumerate(BOMBS.values()):
        if len(bomb) < 1000:
            (folder / f"bomb-{number}").write_bytes(bomb)


def main() -> None:
    arguments = list(sys.argv)
    if all(argument.startswith("-") for argument in arguments[1:]):
        folder = Path(tempfile.mkdtemp(prefix="corpus"))
        write_corpus(folder)
        arguments.append(str(folder))
    atheris.Setup(arguments, try_codec)
    atheris.Fuzz()


if __name__ == "__main__":
    main()
