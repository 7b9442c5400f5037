"""A client that sends without end, and everybody else: what they release is still measured, so they
never run out of leases."""

from collections.abc import Iterator

import pytest

from tests.bench.harness import helper
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient
from vram_arbiter.schemas import defaults as d


@pytest.fixture
def flooded(arbiter_daemon: ArbiterProcess) -> Iterator[ArbiterProcess]:
    with helper("flooder.py", arbiter_daemon.endpoint):
        yield arbiter_daemon


def test_releases_are_measured_under_a_flood(flooded: ArbiterProcess) -> None:
    """Readings starved: their thread got the interpreter once in 5 ms and needs it twenty times a
    reading."""
    with WireClient(flooded.endpoint).hello("calm") as calm:
        for number in range(3 * d.LEASES_PER_CLIENT_MAX):
            lease = calm.granted("calm", 4096, nonce=f"n{number}", mode="shared")
            assert calm.ask("release", lease_id=lease["lease_id"], token=lease["token"])["ok"]
            calm.ask("status")
