"""A `ros_action` skill that a ROS 2 server executes: it asks, waits and cancels.

The server moves the robot, not this runner: neither the safety gate nor the emergency stop's
motors see that motion. So it is used only for the interfaces that a deployment names, and the end
of the goal, however it comes, cancels the server's goal.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import logging
import uuid
from typing import Final

from vram_arbiter.runner.protocols import Done, Goal, Hold, StepOutcome
from vram_arbiter.runner.ros2.action_client import ActionClient
from vram_arbiter.runner.ros2.action_server import Status
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


class RosAction(SkillBase):
    """One goal of an action at a time, on the server that the manifest's `interface_name` names."""

    def __init__(self, manifest: RSkillManifest, domain: int) -> None:
        super().__init__(manifest)
        if manifest.ros_integration is None:
            raise ManifestInvalid(f"{manifest.name} has no ros_integration")
        self._defaults: JsonObject = json.loads(manifest.ros_integration.default_goal_json)
        self._name = manifest.ros_integration.interface_name
        self._domain = domain
        self._stack = contextlib.AsyncExitStack()
        self._client: ActionClient | None = None
        self._goal_id: JsonObject = {}
        self._may_run = False  # the server's goal, also one that it has not confirmed yet
        self._result: asyncio.Task[JsonObject] | None = None
        self._ended: StepOutcome | VramError | None = None  # written by the event loop

    # -- event loop
    async def _start(self, goal: Goal) -> None:
        self._ended = None
        if self._client is None:
            client = ActionClient(interface_of(self.manifest), self._name, self._domain)
            self._client = await self._stack.enter_async_context(client)
        await self._client.served(SERVER_S)
        self._goal_id = {"uuid": list(uuid.uuid4().bytes)}
        sent = {"goal_id": self._goal_id, "goal": merge(self._defaults, goal.params)}
        self._may_run = True
        try:
            async with asyncio.timeout(SERVER_S):
                answer = await self._client.call("send_goal", sent)
        except ValueError as error:
            self._may_run = False
            problem = str(error).removeprefix("goal.").removeprefix("goal: ")
            raise BadRequest(f"goal_params: {problem}") from error
        except TimeoutError:
            raise SidecarUnavailable(
                f"{self._name} has not accepted or rejected a goal within {SERVER_S:g} s"
            ) from None
        if not answer["accepted"]:
            self._may_run = False
            raise GoalRejected(f"the server of {self._name} rejects the goal", hint="see its log")
        call = self._client.call("get_result", {"goal_id": self._goal_id})
        self._result = asyncio.create_task(call, name=f"result of {self._name}")
        self._result.add_done_callback(self._conclude)

    def _conclude(self, result: asyncio.Task[JsonObject]) -> None:
        if result.cancelled():
            return
        error = result.exception()
        self._may_run = error is not None
        if error is not None:
            self._ended = (
                error if isinstance(error, VramError) else ModelError(f"{self._name}: {error}")
            )
            return
        status, told = result.result()["status"], result.result()["result"]
        if status == Status.SUCCEEDED:
            self._ended = Done({"result": told})
            return
        why = next((text for text in told.values() if isinstance(text, str) and text), "")
        problem = f"the server of {self._name} ended the goal with status {status}"
        kind = Cancelled if status == Status.CANCELED else ModelError
        code = told.get("error_code")
        self._ended = kind(f"{problem}, error code {code}" + (f": {why}" if why else ""))

    async def _finish(self) -> None:
        result, self._result = self._result, None
        if self._client is not None and self._may_run:
            self._may_run = False
            await self._cancel(self._client)
        if result is not None:
            result.cancel()
            await asyncio.gather(result, return_exceptions=True)

    async def _cancel(self, client: ActionClient) -> None:
        try:
            async with asyncio.timeout(CANCEL_S):
                await client.call("cancel_goal", {"goal_info": {"goal_id": self._goal_id}})
        except (TimeoutError, VramError) as error:
            log.error(
                "%s did not confirm the cancellation (%s): the robot may still move",
                self._name,
                str(error) or f"not within {CANCEL_S:g} s",
            )

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
