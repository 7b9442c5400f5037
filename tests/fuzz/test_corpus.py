"""The corpus of `make fuzz`: known bytes break no parser, and cost little time and memory."""

import tracemalloc

import pytest

pytest.importorskip("aiohttp", reason="needs the full install")

from tests.fuzz.targets import CORPUS, TARGETS, try_input

pytestmark = pytest.mark.heavy

MEMORY_MAX_BYTES = 4 << 20
MEMORY_MAX_BYTES_PER_BYTE = 64


def test_each_target_has_a_corpus() -> None:
    assert {folder.name for folder in CORPUS.iterdir()} == {*TARGETS}


@pytest.mark.parametrize("name", TARGETS)
def test_the_corpus_breaks_nothing(name: str) -> None:
    inputs = [path.read_bytes() for path in sorted((CORPUS / name).iterdir())]
    for data in inputs:  # whatever is imported or made once is now
        try:
            TARGETS[name].run(data)
        except TARGETS[name].refuses:
            pass
    tracemalloc.start()
    try:
        for data in inputs:
            tracemalloc.reset_peak()
            before, _ = tracemalloc.get_traced_memory()
            try_input(TARGETS[name], data)
            peak = tracemalloc.get_traced_memory()[1] - before
            assert peak <= MEMORY_MAX_BYTES + MEMORY_MAX_BYTES_PER_BYTE * len(data), data[:80]
    finally:
        tracemalloc.stop()
