"""Services that a ROS 2 server executes: an independent participant, with types and codec of
Cyclone DDS alone, answers, declines, stays silent and leaves.
"""

import asyncio
import json
import threading
import uuid
from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from tests.support.dds import NETWORK
from tests.support.waiting import PATIENCE_S, eventually
from vram_arbiter.runner.protocols import Done, Goal, Hold
from vram_arbiter.runner.ros2 import served_skills
from vram_arbiter.runner.ros2.served_skills import RosService, service_misfit
from vram_arbiter.schemas.errors import BadRequest, GoalRejected, SidecarUnavailable
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.world import JointState, WorldState

pytestmark = [pytest.mark.heavy, pytest.mark.anyio]
pytest.importorskip("cyclonedds")

from cyclonedds.domain import DomainParticipant  # noqa: E402
from cyclonedds.idl.types import float64, int64, sequence, uint8, uint64  # noqa: E402

from tests.runner.ros2.independent import server_of, struct, valid  # noqa: E402

DOMAIN = 83
WORLD = WorldState(stamp_ns=0, joint_state=JointState(name=(), position=(), stamp_ns=0))
CALL = {"guid": uint64, "seq": int64}
FILLED = {"structure_needs_at_least_one_member": uint8}
STD = "std_srvs.srv.dds_."
ANSWER = {"success": bool, "message": str}
TRIGGER = (
    struct(STD + "Trigger_Request_", **CALL, **FILLED),
    struct(STD + "Trigger_Response_", **CALL, **ANSWER),
)
SET_BOOL = (
    struct(STD + "SetBool_Request_", **CALL, data=bool),
    struct(STD + "SetBool_Response_", **CALL, **ANSWER),
)
EMPTY = (
    struct(STD + "Empty_Request_", **CALL, **FILLED),
    struct(STD + "Empty_Response_", **CALL, **FILLED),
)
PART = struct("lab_msgs.msg.dds_.Part_", name=str, offsets=sequence[float64])
SORT = (
    struct("lab_msgs.srv.dds_.Sort_Request_", **CALL, parts=sequence[PART]),
    struct("lab_msgs.srv.dds_.Sort_Response_", **CALL, count=uint8, picture=sequence[uint8]),
)
DEFINITION = (
    "Part[] parts  # to be sorted\n---\nuint8 count\nuint8[] picture\n"
    + "=" * 80
    + "\nMSG: lab_msgs/Part\nstring name\nfloat64[<=2] offsets\n"
)


class Server:
    """Answers each request as `answer` says: with fields of the reply, or not at all for None."""

    def __init__(self, name: str, kinds: tuple[Any, Any], answer: Any) -> None:
        self.requests: list[Any] = []
        self._reply, self._answer = kinds[1], answer
        self._reader, self._writer = server_of(DomainParticipant(DOMAIN), name, *kinds)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def close(self) -> None:
        self._over.set()
        self._thread.join()
        del self._reader, self._writer

    def _run(self) -> None:
        while not self._over.wait(0.01):
            for asked in valid(self._reader):
                self.requests.append(asked)
                told = self._answer(asked)
                if told is not None:
                    for guid in (asked.guid + 1, asked.guid):  # after another client's
                        self._writer.write(self._reply(guid, asked.seq, *told))


@pytest.fixture
def name(monkeypatch: pytest.MonkeyPatch) -> str:
    monkeypatch.setenv("CYCLONEDDS_URI", NETWORK)
    return f"/n{uuid.uuid4().hex}/service"


@contextmanager
def running_server(name: str, kinds: tuple[Any, Any], answer: Any) -> Iterator[Server]:
    server = Server(name, kinds, answer)
    try:
        yield server
    finally:
        server.close()


def service_manifest(name: str, interface: str, default: Any = None, **ros: str) -> RSkillManifest:
    package, _, kind = interface.partition("/")
    return RSkillManifest.model_validate(
        {
            "name": "lab/service",
            "version": "1.0.0",
            "kind": "ros_service",
            "license": "mit",
            "embodiment_tags": ["any"],
            "chunk_size": 1,
            "latency_budget": {"per_chunk_ms": 1},
            "description": "d",
            "actions": ["release"],
            "actuators_required": [
                {"kind": "joint_position", "control_mode_semantics": {"mode": "absolute"}}
            ],
            "ros_integration": {
                "package": package,
                "interface_type": kind,
                "interface_name": name,
                "default_goal_json": json.dumps(default or {}),
                **ros,
            },
        }
    )


async def outcome(skill: RosService, **params: Any) -> Any:
    await skill.start(Goal("g", "lab/service", params=params))
    try:
        async with asyncio.timeout(PATIENCE_S):
            while isinstance(step := skill.step(WORLD), Hold):
                await asyncio.sleep(0.01)
        return step
    finally:
        await skill.finish()


async def test_a_service_is_called_and_declines_with_its_message(name: str) -> None:
    skill = RosService(service_manifest(name, "std_srvs/SetBool", {"data": True}), DOMAIN)
    with running_server(name, SET_BOOL, lambda asked: (asked.data, f"open {asked.data}")) as server:
        told = {"result": {"success": True, "message": "open True"}}
        assert await outcome(skill) == Done(told)
        with pytest.raises(GoalRejected, match="did not succeed: open False"):
            await outcome(skill, data=False)
        assert await outcome(skill) == Done(told), "each goal is a call of its own"
        with pytest.raises(BadRequest, match="goal_params: data: expected a number"):
            await outcome(skill, data="yes")
        with pytest.raises(BadRequest, match="unknown field door"):
            await outcome(skill, door=1)
        assert [asked.data for asked in server.requests] == [True, False, True]
        await skill.release()


async def test_requests_and_replies_without_fields_are_those_of_ros(name: str) -> None:
    skill = RosService(service_manifest(name, "std_srvs/Empty"), DOMAIN)
    with running_server(name, EMPTY, lambda asked: (0,)):
        assert await outcome(skill) == Done({"result": {}})
        await skill.release()
    again = RosService(service_manifest(name, "std_srvs/Trigger"), DOMAIN)
    with running_server(name, TRIGGER, lambda asked: (True, "")):
        assert await outcome(again) == Done({"result": {"success": True, "message": ""}})
        await again.release()


async def test_a_type_that_the_manifest_defines_is_called(name: str) -> None:
    skill = RosService(service_manifest(name, "lab_msgs/Sort", definition=DEFINITION), DOMAIN)
    with running_server(name, SORT, lambda asked: (len(asked.parts), [1, 255])) as server:
        parts = [{"name": "nut", "offsets": [0.5, 1]}, {"name": "bolt"}]
        told = await outcome(skill, parts=parts)
        assert told == Done({"result": {"count": 2, "picture": [1, 255]}})
        json.dumps(told.data)
        assert [(part.name, list(part.offsets)) for part in server.requests[0].parts] == [
            ("nut", [0.5, 1.0]),
            ("bolt", []),
        ]
        with pytest.raises(BadRequest, match=r"parts\[0\]\.offsets: expected at most 2 items"):
            await outcome(skill, parts=[{"offsets": [1, 2, 3]}])
        await skill.release()


async def test_a_server_that_is_absent_silent_or_leaves_is_told(
    name: str, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(served_skills, "SERVER_S", 0.2)
    skill = RosService(service_manifest(name, "std_srvs/Trigger"), DOMAIN)
    with pytest.raises(SidecarUnavailable, match=rf"no server of {name} within 0.2 s"):
        await outcome(skill)
    monkeypatch.setattr(served_skills, "SERVER_S", PATIENCE_S)
    with running_server(name, TRIGGER, lambda asked: None) as server:
        await skill.start(Goal("g", "lab/service", params={}))
        async with asyncio.timeout(PATIENCE_S):
            while not server.requests:
                assert isinstance(skill.step(WORLD), Hold)
                await asyncio.sleep(0.01)
        await skill.finish()  # by the deadline, a person or the emergency stop
        assert "has not answered: the robot may still move" in caplog.text
        leaving = asyncio.create_task(outcome(skill))
        await eventually(lambda: len(server.requests) >= 2)
    with pytest.raises(SidecarUnavailable, match="its server is gone"):
        await leaving
    await skill.release()


@pytest.mark.parametrize(
    ("interface", "default", "definition", "says"),
    [
        ("std_srvs/Trigger", {}, "", ""),
        ("std_srvs/Trigger", {"data": 1}, "", "unknown field data"),
        ("lab_msgs/Lift", {}, "", "lab_msgs/Lift needs a definition in"),
        ("lab_msgs/Lift", {}, "string a", "needs a line --- between"),
        ("lab_msgs/Lift", {}, "Hook a\n---\n", "lacks that of lab_msgs/msg/Hook"),
        ("lab_msgs/Lift", {}, "= =\n---\n", "the definition of lab_msgs/Lift: Could not parse"),
        ("lab_msgs/Raise", {}, "int8 up\n---\n", ""),
        ("lab_msgs/Raise", {}, "int8 down\n---\n", "already present with different"),
    ],
)
def test_what_keeps_a_service_from_being_called_is_said_before(
    interface: str, default: Any, definition: str, says: str
) -> None:
    service_misfit(service_manifest("/s", "lab_msgs/Raise", definition="int8 up\n---\n"))
    found = service_misfit(service_manifest("/s", interface, default, definition=definition))
    assert says in found if says else not found
