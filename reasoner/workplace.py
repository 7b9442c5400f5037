"""Connections of a reasoner to the runner and the sidecars, and the work on one task with them."""

import argparse
import asyncio
import contextlib
import os
from typing import Self

from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.base import SidecarClient
from vram_arbiter.clients.sidecar.build import build, manifest_file
from vram_arbiter.clients.sidecar.perception import DetectorClient, RewardClient, SceneVlmClient
from vram_arbiter.reasoner.confirm import Confirmations
from vram_arbiter.reasoner.hints import Hints
from vram_arbiter.reasoner.history import RATE_HZ, Past
from vram_arbiter.reasoner.inbox import Inbox
from vram_arbiter.reasoner.llm.base import LlmPlanner
from vram_arbiter.reasoner.llm.config import LlmConfig
from vram_arbiter.reasoner.llm.scripted import ScriptedPlanner
from vram_arbiter.reasoner.llm.transcript import Transcript
from vram_arbiter.reasoner.loop import STEPS_MAX, THINK_MAX_S, run_episode
from vram_arbiter.reasoner.options import LLM_PLANNERS, MANAGED, endpoint
from vram_arbiter.reasoner.palette import OPERATOR, Palette, skills_of
from vram_arbiter.reasoner.perception import FRAME_MAX_AGE_MS, Judge
from vram_arbiter.reasoner.planner import Planner
from vram_arbiter.reasoner.playbooks import Playbook
from vram_arbiter.reasoner.sight import look_at
from vram_arbiter.reasoner.tools import Tools
from vram_arbiter.reasoner.watch import watch
from vram_arbiter.schemas.body import read_body
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.reasoner import Result
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint


class Workplace:
    """`async with Workplace(arguments, llm, playbook) as workplace: await workplace.perform(…)`.

    Skills, cameras and body are asked for at each task: a runner may have been restarted.
    """

    def __init__(
        self,
        arguments: argparse.Namespace,
        llm: LlmConfig | None,
        playbook: Playbook | None,
        confirmations: Confirmations | None,
    ) -> None:
        self._arguments = arguments
        self._llm = llm
        self._playbook = playbook
        self._confirmations = confirmations
        self._transcript = Transcript(arguments.transcript)
        at = endpoint(arguments.runner, "runner")
        self._runner, self._watching, self._eyes = (RunnerClient(at) for _ in range(3))
        arbiter = arguments.arbiter or arbiter_endpoint(os.environ, os.getuid())
        self._hints = None if arbiter == "none" else Hints(arbiter)
        self._detector: DetectorClient | None = None
        self._vlm: SceneVlmClient | None = None
        self._reward: RewardClient | None = None
        self._open = contextlib.AsyncExitStack()
        self.busy = False
        """Whether an episode runs: its inbox takes a cancel."""

    async def __aenter__(self) -> Self:
        """Start the sidecars that are given as manifests and not served. Raises what `build`
        raises."""
        arguments = self._arguments
        async with contextlib.AsyncExitStack() as stack:
            stack.callback(self._transcript.close)
            for client in (self._runner, self._watching, self._eyes):
                stack.push_async_callback(client.close)
            self._detector = await self._given(
                DetectorClient, arguments.detector, "detector", stack
            )
            self._vlm = await self._given(SceneVlmClient, arguments.scene_vlm, "scene-vlm", stack)
            self._reward = await self._given(RewardClient, arguments.reward, "reward", stack)
            self._open = stack.pop_all()
        return self

    async def __aexit__(self, *_: object) -> None:
        await self._open.aclose()

    async def perform(self, task: str, inbox: Inbox) -> Result:
        """Perform one task to its end.

        Raises RunnerUnreachable, and for a task that this planner cannot do on this robot
        BadRequest, UnknownSkill or ConfigError.
        """
        installed = await self._runner.skills()
        session = str(installed.get("session", ""))
        manifests = [RSkillManifest.model_validate(manifest) for manifest in installed["skills"]]
        served: tuple[SidecarClient | None, ...] = (self._detector, self._vlm, self._reward)
        components = {
            name: client for name, client in zip(MANAGED, served, strict=True) if client is not None
        }
        body = read_body(installed.get("body"))
        palette = Palette(
            skills_of(
                manifests, body=body, allow_noncommercial=self._arguments.allow_noncommercial
            ),
            can_locate=self._detector is not None,
            can_query=self._vlm is not None,
            can_judge=self._reward is not None,
            can_look=self._arguments.look,
            cameras=tuple((await self._watching.state()).get("cameras") or ()),
            managed=frozenset(name for name in self._arguments.manage if name in components),
            topics=frozenset({OPERATOR}),
            body=body,
        )
        if self._playbook is not None:
            palette = self._playbook.narrow(palette)
        async with contextlib.AsyncExitStack() as stack:
            judge = self._judge(task, manifests, stack)
            planner = await self._planner(task, palette, stack)
            beside = asyncio.create_task(watch(self._watching, inbox, session))
            stack.callback(beside.cancel)
            tools = Tools(
                self._runner,
                self._detector,
                self._vlm,
                judge=judge,
                palette=palette,
                components=components,
                hints=self._hints,
                session=session,
            )
            confirm = self._confirmations
            self.busy = True
            try:
                result = await run_episode(
                    task,
                    planner,
                    palette,
                    tools if confirm is None else confirm.before(tools),
                    inbox=inbox,
                    look_at=lambda: look_at(self._watching),
                    steps_max=_steps_max(self._playbook),
                    think_max_s=_think_max_s(self._llm),
                )
            finally:
                self.busy = False
        if isinstance(planner, LlmPlanner):
            result["llm"] = planner.tally.as_result(planner.config.model)
        return result

    async def _given[C: SidecarClient](
        self, kind: type[C], given: str | None, name: str, stack: contextlib.AsyncExitStack
    ) -> C | None:
        """Return the client of a sidecar, given as endpoint or manifest; None for "none"."""
        if given == "none":
            return None
        file = manifest_file(given) if given else None
        if file is None:
            client = kind(endpoint(given, name))
            stack.push_async_callback(client.close)
            return client
        arbiter = self._arguments.arbiter
        return await stack.enter_async_context(
            build(
                file,
                kind,
                name=name,
                arbiter=None if arbiter == "none" else arbiter,  # without hints, not without leases
                allow_noncommercial=self._arguments.allow_noncommercial,
            )
        )

    def _judge(
        self, task: str, manifests: list[RSkillManifest], stack: contextlib.AsyncExitStack
    ) -> Judge | None:
        """Return the reward model with a history of pictures, taken as often as its manifest wants
        them.

        The pictures have a connection of their own.
        """
        if self._reward is None:
            return None
        camera = self._arguments.reward_camera
        rates = [manifest.reward.target_fps for manifest in manifests if manifest.reward]
        past = Past(
            lambda: self._eyes.frame(camera, max_age_ms=FRAME_MAX_AGE_MS, encoding="png"),
            rate_hz=min(rates, default=RATE_HZ),
        )
        looking = asyncio.create_task(past.run(), name="past")
        stack.callback(looking.cancel)
        return Judge(self._reward, past, task)

    async def _planner(
        self, task: str, palette: Palette, stack: contextlib.AsyncExitStack
    ) -> Planner:
        if self._llm is None:
            return ScriptedPlanner(task, palette)
        kind = LLM_PLANNERS[self._arguments.planner]
        procedure = self._playbook.procedure if self._playbook is not None else ""
        planner = kind(self._llm, palette, procedure=procedure, transcript=self._transcript)
        return await stack.enter_async_context(planner)


def _steps_max(playbook: Playbook | None) -> int:
    return STEPS_MAX if playbook is None else min(STEPS_MAX, playbook.contract.max_steps)


def _think_max_s(llm: LlmConfig | None) -> float:
    """Return the limit of a decision: a busy server's whole time fits."""
    return THINK_MAX_S if llm is None else max(THINK_MAX_S, llm.busy_s + llm.timeout_s)
