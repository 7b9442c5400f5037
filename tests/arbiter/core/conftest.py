"""Fixtures of the core's tests."""

import pytest

from tests.support.scenes import Tree


@pytest.fixture
def tree() -> Tree:
    return Tree()
