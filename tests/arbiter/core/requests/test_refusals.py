"""Every request for bytes that comes to nothing is in the history with its reason. One that was
refused at once left no trace: an operator saw a program fail and found nothing in history and log.
"""

from typing import Any

import pytest

from tests.support.core_driver import Consumer, CoreDriver, refusal
from vram_arbiter.arbiter.core.requests.requests import PROCESSES_REMEMBERED
from vram_arbiter.schemas.defaults import GIB


@pytest.fixture
def full_queue() -> CoreDriver:
    return CoreDriver(8 * GIB, settings={"waiters_max": 1})


def too_large(person: Consumer) -> None:
    person.try_acquire(9 * GIB)


def on_no_gpu(person: Consumer) -> None:
    person.try_acquire(GIB, gpu="7")


def beyond_the_queue(person: Consumer) -> None:
    person.driver.consumer("first").acquire(7 * GIB)
    person.driver.consumer("second").acquire(7 * GIB)
    person.try_acquire(7 * GIB)


def called_back_though_it_is_here(person: Consumer) -> None:
    lease = person.acquire(GIB)
    person.load(lease)
    person.reacquire(lease)


@pytest.mark.parametrize(
    ("ask", "code", "leased"),
    [
        (too_large, "vram_insufficient", False),
        (on_no_gpu, "unknown_gpu", False),
        (beyond_the_queue, "limit_exceeded", False),
        (called_back_though_it_is_here, "bad_state", True),
    ],
)
def test_what_is_refused_at_once_is_noted_with_its_reason(
    full_queue: CoreDriver, ask: Any, code: str, leased: bool
) -> None:
    """Regression: only waits that ended were in the history."""
    person = full_queue.consumer("big")
    ask(person)
    (note,) = full_queue.notes("refused")
    refused = refusal(full_queue.effects)
    assert (note["code"], note["reason"]) == (code, refused.message)
    assert (note["consumer"], note["pid"], "lease_id" in note) == (
        "big",
        person.process.pid,
        leased,
    )


def test_little_is_remembered_of_those_who_were_refused(full_queue: CoreDriver) -> None:
    refusals = full_queue.arbiter.inspect().refusals
    people = [full_queue.consumer(f"p{number}") for number in range(PROCESSES_REMEMBERED + 1)]
    for person in people:
        too_large(person)
    assert len(refusals) == PROCESSES_REMEMBERED
    people[-1].die()
    assert len(refusals) == PROCESSES_REMEMBERED - 1
    too_large(people[-1])
    assert people[-1].process not in refusals, "it is nobody any more"
