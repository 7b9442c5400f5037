"""Implementation of the tools: one request to the runner or a sidecar, one typed outcome.

Each call goes to the module that performs it; errors of the other side are outcomes. Nothing here
names bytes, leases or victims: loading and unloading are between the sidecars and the arbiter.
"""

import logging
from collections.abc import Mapping
from dataclasses import KW_ONLY, dataclass, field

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.perception import DetectorClient, SceneVlmClient
from vram_arbiter.reasoner.execution import GOAL_GRACE_S, Execution
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.reasoner.outcomes import of_error
from vram_arbiter.reasoner.palette import Palette
from vram_arbiter.reasoner.perception import IDENTITY_S, Judge, Perception, need_permitted
from vram_arbiter.reasoner.planner import Outcome
from vram_arbiter.schemas.errors import NotPermitted, VramError
from vram_arbiter.schemas.tools import (
    EmitPrompt,
    ExecuteRskill,
    LifecycleTransition,
    LocateInView,
    Look,
    QueryScene,
    QueryTaskProgress,
    ToolCall,
)

log = logging.getLogger(__name__)


@dataclass
class Tools:
    """Dispatch to a runner, a detector, a scene VLM and a reward model, started on demand.

    `components` are the sidecars by name that `lifecycle_transition` may load and unload, if the
    palette allows it. `session` is the runner's when the task began: another one gets no goal.
    """

    runner: RunnerClient
    detector: DetectorClient | None
    scene_vlm: SceneVlmClient | None
    _: KW_ONLY
    judge: Judge | None = None
    palette: Palette | None = None
    components: Mapping[str, SidecarClient] = field(default_factory=dict)
    hints: Hints | None = None
    session: str = ""
    goal_grace_s: float = GOAL_GRACE_S

    def __post_init__(self) -> None:
        self._perception = Perception(
            self.runner, self.detector, self.scene_vlm, self.judge, self.palette
        )
        self._execution = Execution(
            self.runner, self.palette, self.hints, self.session, self.goal_grace_s
        )

    async def __call__(self, call: ToolCall) -> Outcome:
        """Execute a call. Never raises for errors of the other side; they are part of the
        outcome.
        """
        try:
            match call:
                case LocateInView():
                    return await self._perception.locate(call)
                case QueryScene():
                    return await self._perception.query(call)
                case Look():
                    return await self._perception.show(call)
                case QueryTaskProgress():
                    return await self._perception.progress(call)
                case ExecuteRskill():
                    return await self._execution(call)
                case LifecycleTransition():
                    return await self._transition(call)
                case EmitPrompt():
                    log.warning("to %s: %s", call.target_topic, call.text)
                    return Outcome("done", f"said to {call.target_topic}")
                case _:
                    raise NotPermitted(f"{call.tool} is not provided here")
        except VramError as error:
            return of_error(error)

    async def _transition(self, call: LifecycleTransition) -> Outcome:
        """`configure` checks presence, `activate` loads, `deactivate` and `cleanup` unload.

        Never beside a goal: the state is read just before, and a goal that begins in between has
        its lease in use, which the arbiter protects.
        """
        component = self.components.get(call.node)
        if component is None:
            raise NotPermitted(f"no component {call.node} to manage")
        if call.transition == "configure":
            identity = await component.ping(timeout_s=IDENTITY_S)
            return Outcome("done", f"{call.node} serves {identity['rskill']}, {identity['state']}")
        if (goal := (await self.runner.state())["goal"]) is not None:
            why = f"goal {goal} runs: nothing is loaded or unloaded beside it"
            return Outcome("refused", why, "bad_state", {"goal": goal})
        if call.transition == "activate":
            await need_permitted(component, self.palette)
            loaded = await component.load()
            since = "" if loaded["loaded"] else " as before"
            return Outcome("done", f"{call.node} is resident{since}")
        await component.unload()
        return Outcome("done", f"{call.node} leaves at its next safe point")
