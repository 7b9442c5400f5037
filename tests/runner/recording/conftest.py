"""Recorders of this package fork their writers."""

from collections.abc import Iterator

import pytest

from tests.support.dataset_writer import FORKING
from vram_arbiter.runner.recording import writer_process


@pytest.fixture(scope="package", autouse=True)
def forked_writers() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer_process, "subprocess", FORKING)
        yield
