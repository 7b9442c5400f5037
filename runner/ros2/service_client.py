"""Client of ROS 2 services over DDS, as rmw_cyclonedds speaks them. Needs no ROS installation.

A service is a topic of requests and one of replies, which name the client and the request. An
action is three services (`send_goal`, `get_result`, `cancel_goal`) below `NAME/_action`; its
feedback and status topics are not read. A thread of its own waits for replies; calls are awaited on
the event loop.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
from collections.abc import Mapping
from typing import TYPE_CHECKING, Self

from vram_arbiter.runner.sensors.dds_thread import DdsThread
from vram_arbiter.runner.sensors.ros2_dds import dds_problems, full_topic, reader_of, writer_of
from vram_arbiter.runner.sensors.ros2_types import action_of, cdr_of, read, sample_of, write
from vram_arbiter.schemas.errors import ConfigError, SidecarUnavailable
from vram_arbiter.schemas.plain import JsonMap, JsonObject

if TYPE_CHECKING:
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader

log = logging.getLogger(__name__)

REPLIES_KEPT = 16
SERVICES = ("send_goal", "get_result", "cancel_goal")
CANCEL = "action_msgs/srv/CancelGoal"


def action_services(interface: str) -> dict[str, str]:
    """Return the types of an action's services by their names below its own."""
    action = action_of(interface)
    kinds = (f"{action}_SendGoal", f"{action}_GetResult", CANCEL)
    return {f"/_action/{name}": kind for name, kind in zip(SERVICES, kinds, strict=True)}


class ServiceClient:
    """`async with ServiceClient("/open", {"": "std_srvs/srv/Trigger"}, 0) as client:`

    `kinds`: the types of its services, by what their names have behind `name`. Raises ConfigError:
    a wrong name; entering: DDS cannot be started.
    """

    def __init__(self, name: str, kinds: Mapping[str, str], domain: int) -> None:
        try:
            self.name = full_topic(name)
        except ValueError as error:
            raise ConfigError(f"interface_name: {error}") from error
        self._kinds = dict(kinds)
        self._domain = domain
        self._guid = secrets.randbits(63)
        self._sent = 0
        self._waiting: dict[tuple[str, int], asyncio.Future[JsonObject]] = {}
        self._writers: dict[str, DataWriter] = {}
        self._readers: dict[str, DataReader] = {}
        self._served = asyncio.Event()

    async def __aenter__(self) -> Self:
        self._loop = asyncio.get_running_loop()
        with dds_problems(self._domain):
            self._thread = self._open()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._thread.stop()
        self._writers.clear()
        self._readers.clear()

    async def served(self, timeout_s: float) -> None:
        """Wait for a server. Raises SidecarUnavailable."""
        try:
            async with asyncio.timeout(timeout_s):
                await self._served.wait()
        except TimeoutError:
            raise SidecarUnavailable(
                f"no server of {self.name} within {timeout_s:g} s",
                hint="is it running, on this ROS_DOMAIN_ID and network (CYCLONEDDS_URI)?",
            ) from None

    async def call(self, service: str, fields: JsonMap) -> JsonObject:
        """Send a request and wait for its reply, without a limit. Raises ValueError for fields that
        the request does not have."""
        self._sent += 1
        number = self._sent
        kind = self._kinds[service] + "_Request"
        cdr = write(kind, {"guid": self._guid, "seq": number, **fields})
        reply = self._waiting[service, number] = self._loop.create_future()
        try:
            self._writers[service].write(sample_of(kind, cdr))
            answer: JsonObject = await reply
            return answer
        finally:
            del self._waiting[service, number]

    # -- DDS
    def _open(self) -> DdsThread:
        from cyclonedds.core import DDSStatus
        from cyclonedds.domain import DomainParticipant

        participant = DomainParticipant(self._domain)
        for service, kind in self._kinds.items():
            path = self.name + service
            writer = self._writers[service] = writer_of(
                participant, f"rq{path}Request", f"{kind}_Request", kept=REPLIES_KEPT, wait_s=1
            )
            reader = self._readers[service] = reader_of(
                participant, f"rr{path}Reply", f"{kind}_Response", kept=REPLIES_KEPT
            )
            writer.set_status_mask(DDSStatus.PublicationMatched)
            reader.set_status_mask(DDSStatus.SubscriptionMatched)
        readers, writers = self._readers.values(), self._writers.values()
        return DdsThread(
            "ros2-client", participant, readers, [*writers, *readers], self._woken, self._failed
        )

    # -- on its thread
    def _woken(self) -> None:
        self._loop.call_soon_threadsafe(self._found, self._matched())
        for service, reader in self._readers.items():
            for sample in reader.take(N=REPLIES_KEPT):
                if sample.sample_info.valid_data:
                    self._took(service, cdr_of(sample))

    def _failed(self, problem: str) -> None:
        self._loop.call_soon_threadsafe(self._fail, f"DDS failed: {problem}")

    def _matched(self) -> bool:
        """Return whether a server has all services."""
        counts = [w.get_publication_matched_status().current_count for w in self._writers.values()]
        counts += [
            r.get_subscription_matched_status().current_count for r in self._readers.values()
        ]
        return all(counts)

    def _took(self, service: str, cdr: bytes) -> None:
        try:
            reply = read(self._kinds[service] + "_Response", cdr)
        except ValueError as error:
            log.warning("a reply of %s%s cannot be read: %s", self.name, service, error)
            return
        if reply["guid"] == self._guid:  # else it is another client's
            self._loop.call_soon_threadsafe(self._settle, service, reply)

    # -- on the event loop
    def _found(self, matched: bool) -> None:
        if matched:
            self._served.set()
        elif self._served.is_set():
            self._served.clear()
            self._fail("its server is gone")

    def _settle(self, service: str, reply: JsonObject) -> None:
        waiting = self._waiting.get((service, reply["seq"]))
        if waiting is not None and not waiting.done():
            waiting.set_result(reply)

    def _fail(self, problem: str) -> None:
        for waiting in self._waiting.values():
            if not waiting.done():
                waiting.set_exception(SidecarUnavailable(f"{self.name}: {problem}"))
