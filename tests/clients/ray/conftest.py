"""Two boxes of real raylets, for the tests of a file."""

from collections.abc import Iterator

import pytest

from tests.support.boxes import Boxes


@pytest.fixture(scope="module")
def boxes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Boxes]:
    with Boxes(tmp_path_factory.mktemp("b"), nodes=2) as boxes:
        boxes.connect()
        yield boxes
