"""For recorders that fork their writers."""

from collections.abc import Iterator

import pytest

from tests.support.dataset_writer import FORKING
from tests.support.prepared import warm
from vram_arbiter.runner.recording import recorder


@pytest.fixture(scope="package")
def forked_writers() -> Iterator[None]:
    """Let recorders of this process, and of runners that it forks, fork their writers."""
    warm("dataset-writer")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(recorder, "subprocess", FORKING)
        yield
