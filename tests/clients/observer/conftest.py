"""Fixtures of the observer's tests: an engine whose notes it reads."""

from importlib.util import find_spec

import pytest

from tests.support.busy import busy_driver
from tests.support.core_driver import CoreDriver
from vram_arbiter.schemas.defaults import GIB

if not all(find_spec(name) for name in ("starlette", "uvicorn", "httpx", "prometheus_client")):
    collect_ignore_glob = ["*"]  # the base install has not the extra `observer`


@pytest.fixture(scope="session")
def busy() -> CoreDriver:
    """A run of the engine with a bit of everything; read only."""
    return busy_driver(7, steps=50)


@pytest.fixture
def driver() -> CoreDriver:
    """An engine with one simulated GPU of 8 GiB."""
    return CoreDriver(8 * GIB)
