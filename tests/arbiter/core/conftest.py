"""Fixtures of the core's tests."""

import pytest

from arbiter.testing.scenes import Tree


@pytest.fixture
def tree() -> Tree:
    return Tree()
