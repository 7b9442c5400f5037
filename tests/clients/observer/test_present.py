"""One question serves all."""

import asyncio

from tests.support.core_driver import CoreDriver
from vram_arbiter.clients.observer.present import Look, Present
from vram_arbiter.schemas.errors import ArbiterUnreachable
from vram_arbiter.schemas.wire.replies import StatusReply


class Client:
    """Answers from an engine as the daemon does, and counts the questions."""

    connected = True

    def __init__(self, driver: CoreDriver) -> None:
        self.driver = driver
        self.asked = 0
        self.away = False

    async def status(self) -> StatusReply:
        self.asked += 1
        await asyncio.sleep(0)
        if self.away:
            raise ArbiterUnreachable("gone")
        return self.driver.arbiter.status(self.driver.now)


def test_questions_at_a_time_are_one_and_a_silent_arbiter_is_told(driver: CoreDriver) -> None:
    client, heard = Client(driver), list[Look | None]()

    async def story() -> None:
        asking = Present(client, heard.append)  # type: ignore[arg-type]
        first, second = await asyncio.gather(asking.look(1.0), asking.look(1.0))
        assert first is second is not None
        assert client.asked == 1
        client.away = True
        assert await asking.look() is None
        client.connected = False
        assert await asking.look() is None
        assert client.asked == 2, "nothing is asked of an arbiter that is not there"

    asyncio.run(story())
    assert [look is None for look in heard] == [False, True, True]
