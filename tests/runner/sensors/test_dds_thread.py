"""The thread that waits in DDS, with a real participant."""

from queue import SimpleQueue

import pytest

from tests.support.dds import NETWORK
from vram_arbiter.runner.sensors.dds_thread import DdsThread

pytestmark = pytest.mark.heavy
pytest.importorskip("cyclonedds")

ANSWER_S = 30.0


def test_an_error_of_the_callback_is_heard_before_the_thread_ends(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Regression: only errors of DDS were. After any other one the requests of an action client
    waited for replies that no thread read.
    """
    from cyclonedds.domain import DomainParticipant

    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    failed: SimpleQueue[str] = SimpleQueue()

    def woken() -> None:
        raise ZeroDivisionError("a defect")

    participant = DomainParticipant(80)
    thread = DdsThread("test", participant, [], [], woken, failed.put)
    assert failed.get(timeout=ANSWER_S) == "ZeroDivisionError: a defect"
    thread.close()
    assert not thread.alive
