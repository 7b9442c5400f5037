"""Skills that a ROS 2 server executes: a `ros_action` asks, waits and cancels, a `ros_service` asks
and waits.

The server moves the robot, not this runner: neither the safety gate nor the emergency stop's
motors see that motion. So they are used only for the interfaces that a deployment names. The end of
an action's goal, however it comes, cancels the server's goal; a service cannot be canceled.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import uuid
from abc import abstractmethod
from collections.abc import Mapping
from typing import Final

from vram_arbiter.runner.protocols import Done, Goal, Hold, StepOutcome
from vram_arbiter.runner.ros2.action_server import Status
from vram_arbiter.runner.ros2.service_client import ServiceClient, action_services
from vram_arbiter.runner.sensors.ros2_types import FILLER, service_of, write
from vram_arbiter.runner.skills.base import SkillBase
from vram_arbiter.runner.skills.ros_goals import merge
from vram_arbiter.runner.skills.ros_standins import interface_of
from vram_arbiter.schemas.errors import (
    BadRequest,
    Cancelled,
    GoalRejected,
    ManifestInvalid,
    ModelError,
    SidecarUnavailable,
    VramError,
)
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.world import WorldState

log = logging.getLogger(__name__)

SERVER_S: Final = 10.0  # for a server to be found, and to accept or reject
CANCEL_S: Final = 2.0
WIRE: Final = "its node needs RMW_IMPLEMENTATION=rmw_cyclonedds_cpp"
"""Other implementations discover our requests and cannot read them."""


class ServedSkill(SkillBase):
    """One goal at a time, on the server that the manifest's `interface_name` names."""

    def __init__(self, manifest: RSkillManifest, kinds: Mapping[str, str], domain: int) -> None:
        """`kinds` as in `ServiceClient`."""
        super().__init__(manifest)
        if manifest.ros_integration is None:
            raise ManifestInvalid(f"{manifest.name} has no ros_integration")
        self._defaults: JsonObject = json.loads(manifest.ros_integration.default_goal_json)
        self._name = manifest.ros_integration.interface_name
        self._kinds = kinds
        self._domain = domain
        self._stack = contextlib.AsyncExitStack()
        self._client: ServiceClient | None = None
        self._may_run = False  # the server's goal, also one that it has not confirmed yet
        self._result: asyncio.Task[JsonObject] | None = None
        self._ended: StepOutcome | VramError | None = None  # written by the event loop

    # -- event loop
    async def _start(self, goal: Goal) -> None:
        self._ended = None
        if self._client is None:
            client = ServiceClient(self._name, self._kinds, self._domain)
            self._client = await self._stack.enter_async_context(client)
        await self._client.served(SERVER_S)
        try:
            await self._ask(self._client, merge(self._defaults, goal.params))
        except ValueError as error:
            self._may_run = False
            problem = str(error).removeprefix("goal.").removeprefix("goal: ")
            raise BadRequest(f"goal_params: {problem}") from error

    @abstractmethod
    async def _ask(self, client: ServiceClient, params: JsonObject) -> None:
        """Send the goal and `_await` its result. Raises ValueError for fields that it lacks."""

    def _await(self, client: ServiceClient, service: str, fields: JsonObject) -> None:
        call = client.call(service, fields)
        self._result = asyncio.create_task(call, name=f"result of {self._name}")
        self._result.add_done_callback(self._conclude)

    def _conclude(self, result: asyncio.Task[JsonObject]) -> None:
        if result.cancelled():
            return
        error = result.exception()
        self._may_run = error is not None
        if error is None:
            self._ended = self._outcome(result.result())
        else:
            self._ended = (
                error if isinstance(error, VramError) else ModelError(f"{self._name}: {error}")
            )

    @abstractmethod
    def _outcome(self, answer: JsonObject) -> Done | VramError:
        """Return how the goal ended, from the last answer."""

    async def _finish(self) -> None:
        result, self._result = self._result, None
        if self._client is not None and self._may_run:
            self._may_run = False
            await self._leave(self._client)
        if result is not None:
            result.cancel()
            await asyncio.gather(result, return_exceptions=True)

    @abstractmethod
    async def _leave(self, client: ServiceClient) -> None:
        """End a goal that may still run at the server."""

    async def _release(self) -> None:
        await self._stack.aclose()
        self._client = None

    # -- control thread
    def _step(self, world: WorldState) -> StepOutcome:
        ended = self._ended
        if isinstance(ended, VramError):
            raise ended
        if ended is not None:
            self.fraction = 1.0
            return ended
        return Hold(f"the server of {self._name} is at work")


class RosAction(ServedSkill):
    """Goals of an action."""

    def __init__(self, manifest: RSkillManifest, domain: int) -> None:
        super().__init__(manifest, action_services(interface_of(manifest)), domain)
        self._goal_id: JsonObject = {}

    async def _ask(self, client: ServiceClient, params: JsonObject) -> None:
        self._goal_id = {"uuid": list(uuid.uuid4().bytes)}
        self._may_run = True
        try:
            async with asyncio.timeout(SERVER_S):
                answer = await client.call(
                    "/_action/send_goal", {"goal_id": self._goal_id, "goal": params}
                )
        except TimeoutError:
            raise SidecarUnavailable(
                f"{self._name} has not accepted or rejected a goal within {SERVER_S:g} s",
                hint=WIRE,
            ) from None
        if not answer["accepted"]:
            self._may_run = False
            raise GoalRejected(f"the server of {self._name} rejects the goal", hint="see its log")
        self._await(client, "/_action/get_result", {"goal_id": self._goal_id})

    def _outcome(self, answer: JsonObject) -> Done | VramError:
        status, told = answer["status"], answer["result"]
        if status == Status.SUCCEEDED:
            return Done({"result": told})
        why = next((text for text in told.values() if isinstance(text, str) and text), "")
        problem = f"the server of {self._name} ended the goal with status {status}"
        kind = Cancelled if status == Status.CANCELED else ModelError
        code = told.get("error_code")
        return kind(f"{problem}, error code {code}" + (f": {why}" if why else ""))

    async def _leave(self, client: ServiceClient) -> None:
        try:
            async with asyncio.timeout(CANCEL_S):
                await client.call("/_action/cancel_goal", {"goal_info": {"goal_id": self._goal_id}})
        except (TimeoutError, VramError) as error:
            log.error(
                "%s did not confirm the cancellation (%s): the robot may still move",
                self._name,
                str(error) or f"not within {CANCEL_S:g} s",
            )


class RosService(ServedSkill):
    """Calls of a service. Its reply's `success`, where it has one, decides."""

    def __init__(self, manifest: RSkillManifest, domain: int) -> None:
        """Raises ValueError for a type that is not known."""
        super().__init__(manifest, {"": service_kind(manifest)}, domain)

    async def _ask(self, client: ServiceClient, params: JsonObject) -> None:
        write(self._kinds[""] + "_Request", {"guid": 0, "seq": 0, **params})  # refused before sent
        self._may_run = True
        self._await(client, "", params)

    def _outcome(self, answer: JsonObject) -> Done | VramError:
        left_out = ("guid", "seq", FILLER)
        reply = {name: value for name, value in answer.items() if name not in left_out}
        told: JsonObject = json.loads(json.dumps(reply, default=list))  # bytes are numbers, too
        if told.get("success", True):
            return Done({"result": told})
        why = told.get("message") or "it gives no reason"
        return GoalRejected(f"the server of {self._name} answers that it did not succeed: {why}")

    async def _leave(self, client: ServiceClient) -> None:
        log.error("%s has not answered: the robot may still move; %s", self._name, WIRE)


def service_kind(manifest: RSkillManifest) -> str:
    """Return the name of a service's types, which are known then. Raises ValueError."""
    ros = manifest.ros_integration
    return service_of(interface_of(manifest), ros.definition if ros is not None else "")


def service_misfit(manifest: RSkillManifest) -> str:
    """Return what keeps a service from being called: its definition, or default fields that it does
    not have. Empty: nothing."""
    try:
        kind = service_kind(manifest)
        assert manifest.ros_integration is not None, "the kind requires it"
        default = json.loads(manifest.ros_integration.default_goal_json)
        write(f"{kind}_Request", {"guid": 0, "seq": 0, **default})
    except ValueError as error:
        return str(error)
    return ""
