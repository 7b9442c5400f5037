"""A robot with a tunnel to the arbiter of a GPU server."""

from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.support.process import Make
from tests.support.remote import Remote


@pytest.fixture
def remote(make_arbiter: Make, tmp_path: Path) -> Iterator[Remote]:
    with Remote(make_arbiter, tmp_path) as made:
        yield made
