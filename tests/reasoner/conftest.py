"""A runner and a perception sidecar that speak the real wires on real sockets, without robot and
models.
"""

import asyncio
from collections.abc import AsyncIterator, Callable
from contextlib import AbstractAsyncContextManager, asynccontextmanager
from pathlib import Path
from typing import Any

import pytest
from pydantic import TypeAdapter

from tests.support.field_server import PNG
from tests.support.serving import answering
from vram_arbiter.clients.net.server import Peer, RouterServer
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.errors import BadRequest, FrameStale, GoalRejected, VramError
from vram_arbiter.schemas.goals import (
    CancelGoal,
    GetFrame,
    GetResult,
    GetSkills,
    GetState,
    RunnerRequest,
    SendGoal,
)
from vram_arbiter.schemas.plain import Message

SESSION = "this-session"


class Runner:
    """One goal at a time, ended by the test; `deaf` ops are never answered."""

    def __init__(self, endpoint: str) -> None:
        self.endpoint = endpoint
        self.goal: SendGoal | None = None
        self.peer: Peer | None = None
        self.accepted = asyncio.Event()
        self.cancelled: list[str] = []
        self.deaf: set[str] = set()
        self.estop: str | None = None
        self.skills: list[dict[str, Any]] = []
        self.diagnostics: dict[str, str] = {}
        self.world: Message = {}
        self.frame_error: VramError | None = None
        self.frames: list[GetFrame] = []
        self.frame_data = PNG
        self.stamp_step_ns = 1
        self.camera_model: dict[str, Any] | None = None
        self.ends_on_cancel = True
        self.result_error: VramError | None = None
        self.heard = asyncio.Event()
        """An op that is not answered has come."""
        self.server = RouterServer(
            endpoint, lambda error: {"re": None, "ok": False, "error": error.to_wire()}
        )

    async def end(self, status: str = "succeeded", *, code: str = "", message: str = "") -> None:
        assert self.goal is not None, "no goal runs"
        goal, self.goal = self.goal, None
        assert self.peer is not None, "somebody sent it"
        push = {
            "push": "result",
            "goal_id": goal.goal_id,
            "status": status,
            "success": status == "succeeded",
            "code": code,
            "message": message,
            "data": {},
        }
        await self.server.send(self.peer, push)

    async def feed(self, progress: float, state: str = "running") -> None:
        assert self.goal is not None, "no goal runs"
        assert self.peer is not None, "somebody sent it"
        push = {
            "push": "feedback",
            "goal_id": self.goal.goal_id,
            "progress": progress,
            "state": state,
            "tick_idx": 0,
            "detail": "",
        }
        await self.server.send(self.peer, push)

    async def handle(self, peer: Peer, message: Message) -> None:
        request = TypeAdapter[Any](RunnerRequest).validate_python(message)
        number = {"re": request.id}
        try:
            reply = await self._answer(peer, request)
        except VramError as error:
            await self.server.send(peer, {**number, "ok": False, "error": error.to_wire()})
            return
        if request.op in self.deaf:
            self.heard.set()
        else:
            await self.server.send(peer, {**number, "ok": True, **reply})
        if isinstance(request, CancelGoal) and self.goal is not None and self.ends_on_cancel:
            await self.end("canceled")

    async def _answer(self, peer: Peer, request: Any) -> Message:
        match request:
            case SendGoal():
                if self.goal is not None or request.session not in ("", SESSION):
                    raise GoalRejected("another goal is running, or it is another runner's")
                self.goal, self.peer = request, peer
                self.accepted.set()
                return {"goal_id": request.goal_id, "accepted": True}
            case CancelGoal(goal_id=goal_id):
                self.cancelled.append(goal_id)
                if self.goal is None or self.goal.goal_id != goal_id:
                    raise BadRequest(f"there is no goal {goal_id}")
                return {"goal_id": goal_id}
            case GetFrame():
                self.frames.append(request)
                if self.frame_error is not None:
                    raise self.frame_error
                model = {} if self.camera_model is None else {"camera_model": self.camera_model}
                return {
                    "camera": request.camera or "front",
                    "encoding": "png",
                    "data": self.frame_data,
                    "width": 4,
                    "height": 4,
                    "stamp_monotonic_ns": 1 + len(self.frames) * self.stamp_step_ns,
                    "age_ms": 1.0,
                    **model,
                }
            case GetState():
                return {
                    "goal": self.goal.goal_id if self.goal else None,
                    "phase": "idle",
                    "estop": self.estop,
                    "world": {"diagnostics": dict(self.diagnostics)} | self.world,
                    "session": SESSION,
                }
            case GetSkills():
                return {"skills": self.skills, "resident": None, "session": SESSION}
            case GetResult():
                raise self.result_error or BadRequest("asked too early")
        return {}


class Sidecar:
    """Answers `detect` and `query` with `answer`, or fails with `error`."""

    def __init__(self, endpoint: str, rskill: str) -> None:
        self.endpoint = endpoint
        self.rskill = rskill
        self.asked: list[str] = []
        self.error: VramError | None = None
        self.detections: list[dict[str, Any]] = []
        self.judgement: dict[str, Any] = {
            "progress": [0.2, 0.7],
            "success": [0.1, 0.9],
            "success_threshold": 0.5,
        }
        self.messages: list[Message] = []
        self.late = 0
        """So many requests about pictures that it comes to too late."""
        self.server = RouterServer(
            endpoint, lambda error: {"ok": False, "error": str(error), "code": error.code}
        )

    async def handle(self, peer: Peer, message: Message) -> None:
        op = message["op"]
        self.asked.append(op)
        self.messages.append(message)
        reply: Message = {"re": message["id"], "ok": True}
        if op == "ping":
            reply |= {
                "model": "m",
                "revision": "",
                "kind": "vlm",
                "rskill": self.rskill,
                "pid": 1,
                "boot_id": "b",
                "state": "unloaded",
            }
        elif (error := self.error) is not None or (op != "load" and self.late):
            if error is None:
                error, self.late = FrameStale("it waited"), self.late - 1
            wire = error.to_wire()
            reply |= {
                "ok": False,
                "error": f"{type(error).__name__}: {error.message}",
                "code": wire["code"],
            }
        elif op == "load":
            reply |= {"lease_id": "l", "token": [1, 1], "loaded": True}
        else:
            reply |= {
                "answer": "Yes, a red cube.",
                "norm": 1000,
                "detections": self.detections,
                **self.judgement,
            }
        await self.server.send(peer, reply)


@asynccontextmanager
async def _served(program: Any) -> AsyncIterator[Any]:
    async with answering(program.server, program.handle):
        yield program


@pytest.fixture
def a_runner(tmp_path: Path) -> Callable[[], AbstractAsyncContextManager[Runner]]:
    return lambda: _served(Runner(f"ipc://{tmp_path}/runner.sock"))


@pytest.fixture
def a_sidecar(tmp_path: Path) -> Callable[[str], AbstractAsyncContextManager[Sidecar]]:
    return lambda rskill: _served(
        Sidecar(f"ipc://{tmp_path}/{rskill.replace('/', '-')}.sock", rskill)
    )


@pytest.fixture
async def runner(a_runner: Callable[[], AbstractAsyncContextManager[Runner]]) -> AsyncIterator[Any]:
    async with a_runner() as made:
        yield made


@pytest.fixture
async def client(runner: Runner) -> AsyncIterator[RunnerClient]:
    async with RunnerClient(runner.endpoint) as made:
        yield made
