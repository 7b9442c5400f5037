"""Goals of a runner as a ROS 2 action: the field's `openral_msgs/ExecuteRskill`.

A plain client of the runner's goal socket, in a process of its own: DDS cannot hold up the control
loop. The runner's deadline, gate and emergency stop hold for these goals as for any other.
"""

from __future__ import annotations

import contextlib
import json
import secrets
from collections.abc import AsyncIterator
from typing import Final

from vram_arbiter.clients.runner import Goal, RunnerClient
from vram_arbiter.runner.ros2.action_server import Execution, Status
from vram_arbiter.schemas.errors import BadRequest, RunnerUnreachable
from vram_arbiter.schemas.plain import JsonObject
from vram_arbiter.schemas.runtime.telemetry import traceparent

INTERFACE: Final = "openral_msgs/ExecuteRskill"
NAME: Final = "/openral/execute_rskill"
ENDINGS: Final = {
    "succeeded": Status.SUCCEEDED,
    "canceled": Status.CANCELED,
    "failed": Status.ABORTED,
    "deadline": Status.ABORTED,
}
PHASES: Final = {"acquiring": "loading", "starting": "warming", "running": "executing"}
"""The runner's states under the action's names; others are told as they are."""


class RunnerGoals:
    """Accepts goals of the action for the runner of `client`."""

    def __init__(self, client: RunnerClient) -> None:
        self._client = client

    async def accept(self, goal_id: str, goal: JsonObject) -> Execution:
        """Send a goal to the runner.

        A W3C `traceparent` in `prompt_metadata_json` is joined, and nothing else there is read.
        Raises BadRequest, and what the runner refuses it with.
        """
        caller = _traceparent(goal["prompt_metadata_json"])
        context = caller or f"00-{secrets.token_hex(16)}-{secrets.token_hex(8)}-01"
        sent = await self._client.send_goal(
            goal["rskill_id"],
            revision=goal["revision"],
            prompt=goal["prompt"],
            goal_params=_params(goal["goal_params_json"]),
            deadline_s=max(0.0, goal["deadline_s"]),
            goal_id=goal_id,
            traceparent=context,
        )
        return _RunnerGoal(sent, context.split("-")[1])


class _RunnerGoal:
    def __init__(self, goal: Goal, trace_id: str) -> None:
        self._goal, self._trace_id = goal, trace_id

    async def feedback(self) -> AsyncIterator[JsonObject]:
        async for push in self._goal.feedback():
            state = PHASES.get(push["state"], push["state"])
            yield {"progress": push["progress"], "state": state}

    async def result(self) -> tuple[Status, JsonObject]:
        try:
            result = await self._goal.result()
        except (BadRequest, RunnerUnreachable) as error:
            reason = f"{error.code}: {error}"
            return Status.ABORTED, self._as_result(success=False, reason=reason)
        reason = ": ".join(filter(None, (result["code"], result["message"])))
        return ENDINGS[result["status"]], self._as_result(result["success"], reason)

    async def cancel(self) -> None:
        await self._goal.cancel()

    def _as_result(self, success: bool, reason: str) -> JsonObject:
        return {"success": success, "failure_reason": reason, "trace_id": self._trace_id}


def _traceparent(text: str) -> str | None:
    """Return the caller's traceparent; None for everything else, which is no reason to refuse."""
    with contextlib.suppress(ValueError, RecursionError):
        metadata = json.loads(text)
        if isinstance(metadata, dict):
            return traceparent.read(metadata.get("traceparent"))
    return None


def _params(text: str) -> JsonObject:
    try:
        params = json.loads(text) if text else {}
    except ValueError as error:
        raise BadRequest(f"goal_params_json: expected a JSON object: {error}") from error
    if not isinstance(params, dict):
        raise BadRequest(f"goal_params_json: expected a JSON object, got {text!r:.60}")
    return params
