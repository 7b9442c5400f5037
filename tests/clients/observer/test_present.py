"""One question serves all; of many leases those that changed are asked for alone."""

import asyncio

import pytest

from tests.support.core_driver import CoreDriver
from vram_arbiter.clients.observer import present
from vram_arbiter.clients.observer.present import Look, Present
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import ArbiterUnreachable
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import Status


class Client:
    """Answers from an engine as the daemon does, and keeps what was asked."""

    connected = True

    def __init__(self, driver: CoreDriver) -> None:
        self.driver = driver
        self.asked: list[Status] = []
        self.away = False

    async def ask(self, request: Status, **_: object) -> StatusReply:
        self.asked.append(request)
        await asyncio.sleep(0)
        if self.away:
            raise ArbiterUnreachable("gone")
        engine, now = self.driver.arbiter, self.driver.now
        if request.leases:
            return engine.leases(request.leases, now)
        return engine.status(now)

    async def status(self) -> StatusReply:
        return await self.ask(Status())


def test_questions_at_a_time_are_one_and_a_silent_arbiter_is_told(driver: CoreDriver) -> None:
    client, heard = Client(driver), list[Look | None]()

    async def story() -> None:
        asking = Present(client, heard.append)  # type: ignore[arg-type]
        first, second = await asyncio.gather(asking.look(1.0), asking.look(1.0))
        assert first is second is not None
        assert len(client.asked) == 1
        client.away = True
        assert await asking.look() is None
        client.connected = False
        assert await asking.look() is None
        assert len(client.asked) == 2, "nothing is asked of an arbiter that is not there"

    asyncio.run(story())
    assert [look is None for look in heard] == [False, True, True]


def test_of_many_leases_those_that_changed_are_asked_for(
    driver: CoreDriver, monkeypatch: pytest.MonkeyPatch
) -> None:
    """All pages were read for each event: with a thousand leases a page heard of a change after
    half a second."""
    monkeypatch.setattr(present, "SOME_MAX", 4)
    client = Client(driver)
    people = [driver.consumer(f"c{number}") for number in range(6)]
    leases = []
    for person in people:
        leases.append(person.acquire(64 * MIB))
        person.load(leases[-1])

    def states(look: Look | None) -> dict[str, str]:
        assert look is not None
        return {lease.lease_id: lease.state for lease in look.status.leases}

    async def story() -> None:
        asking = Present(client, lambda _: None)  # type: ignore[arg-type]
        assert set(states(await asking.look())) == set(leases)
        assert client.asked == [Status()]
        people[0].use_begin(leases[0])
        people[1].unload(leases[1])
        driver.advance(1.0)
        added = driver.consumer("new").acquire(64 * MIB)
        touched = [leases[0], leases[1], added]
        found = states(await asking.look(touched=touched))
        assert client.asked[1:] == [Status(leases=tuple(touched))]
        assert set(found) == {*leases, added} - {leases[1]}
        assert found[added] == "loading"
        monkeypatch.setattr(present, "WHOLE_S", 0.0)
        assert states(await asking.look(touched=touched)) == found
        assert Status() in client.asked[2:], "all of them again"

    asyncio.run(story())
