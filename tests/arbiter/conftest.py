"""Fixtures of the daemon's own tests."""

import pytest

from tests.support.busy import busy_driver
from tests.support.core_driver import CoreDriver
from vram_arbiter.schemas.defaults import GIB


@pytest.fixture(scope="session")
def busy() -> CoreDriver:
    """A run of the engine with a bit of everything; read only."""
    return busy_driver(7, steps=50)


@pytest.fixture
def driver(request: pytest.FixtureRequest) -> CoreDriver:
    """An engine with one simulated GPU of 8 GiB, or as many as the test's module says (GPUS)."""
    return CoreDriver(8 * GIB, gpus=getattr(request.module, "GPUS", 1))
