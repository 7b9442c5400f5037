"""How a lease leaves, or stays: the client's side without an arbiter."""

from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import anyio
import pytest
from anyio.abc import TaskGroup

from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients._protocol.records import LeaseRecord
from vram_arbiter.clients.eviction import Departure
from vram_arbiter.schemas.errors import BadState
from vram_arbiter.schemas.ids import LeaseId, Token
from vram_arbiter.schemas.wire.replies import AnyReply
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

pytestmark = pytest.mark.anyio


class WithdrawingDriver:
    """An arbiter that withdraws its revoke while the holder announces that it unloads, and refuses
    that then: another process's use is in flight."""

    connected = True
    protocol: Any = SimpleNamespace(holdings=SimpleNamespace(ask=lambda *asked: 1))

    def __init__(self, group: TaskGroup, record: LeaseRecord) -> None:
        self._group, self._record = group, record

    def now(self) -> float:
        return 0.0

    def spawn(self, work: Callable[..., Any], *arguments: object, name: str) -> None:
        self._group.start_soon(work, *arguments, name=name)

    async def reply(self, request_id: int) -> AnyReply:
        self._record.withdrawn = True
        raise BadState("a use is in flight", details={"uses": 1})


async def test_who_waits_for_a_change_hears_of_a_late_withdrawal() -> None:
    """`vramctl run` told its gateway for good that its program was leaving: requests waited until
    their limit for a server that stayed."""
    spec = LeaseSpec("a", "a", Footprint(1, 1, 0))
    view: Any = None
    token = Token(1, 1)
    record = LeaseRecord(LeaseId("L1"), token, "n", spec, 15.0, view, 0.0, 0.0, held=True)
    async with anyio.create_task_group() as group:
        driver = cast(Any, WithdrawingDriver(group, record))
        departure = Departure(driver, record, spec, None, None)
        departure.start()
        with anyio.fail_after(PATIENCE_S):
            while departure.asked:
                await departure.progress.wait()
    assert not departure.gone
