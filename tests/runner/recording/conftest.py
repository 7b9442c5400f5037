"""For recorders that fork their writers."""

from collections.abc import Iterator

import pytest

from tests.support.dataset_writer import FORKING
from tests.support.prepared import warm
from vram_arbiter.runner.recording import writer_process


@pytest.fixture(scope="package")
def forked_writers() -> Iterator[None]:
    """Let recorders of this process, and of runners that it forks, fork their writers."""
    warm("dataset-writer")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_process, "subprocess", FORKING)
        yield
