"""An independent participant's side of a ROS 2 action: types and codec of Cyclone DDS alone."""

import asyncio
import uuid
from typing import Any

from cyclonedds.builtin import (
    BuiltinDataReader,
    BuiltinTopicDcpsParticipant,
    BuiltinTopicDcpsPublication,
    BuiltinTopicDcpsSubscription,
)
from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import array, float64, int8, int64, sequence, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.runner.sensors.ros2_node import Time_, struct
from tests.support.waiting import PATIENCE_S

QUALITY = Qos(
    Policy.Reliability.Reliable(duration(seconds=10)),
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
"""ROS 2's of services."""
LATCHED = Qos(
    Policy.Reliability.Reliable(duration(seconds=10)),
    Policy.Durability.TransientLocal,
    Policy.History.KeepLast(1),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)

Vector3_ = struct("geometry_msgs.msg.dds_.Vector3_", x=float64, y=float64, z=float64)
Quaternion_ = struct(
    "geometry_msgs.msg.dds_.Quaternion_", x=float64, y=float64, z=float64, w=float64
)
Transform_ = struct("geometry_msgs.msg.dds_.Transform_", translation=Vector3_, rotation=Quaternion_)
Gid_ = struct("rmw_dds_common.msg.dds_.Gid_", data=array[uint8, 16])
NodeEntitiesInfo_ = struct(
    "rmw_dds_common.msg.dds_.NodeEntitiesInfo_",
    node_namespace=str,
    node_name=str,
    reader_gid_seq=sequence[Gid_],
    writer_gid_seq=sequence[Gid_],
)
ParticipantEntitiesInfo_ = struct(
    "rmw_dds_common.msg.dds_.ParticipantEntitiesInfo_",
    gid=Gid_,
    node_entities_info_seq=sequence[NodeEntitiesInfo_],
)
UUID_ = struct("unique_identifier_msgs.msg.dds_.UUID_", uuid=array[uint8, 16])
GoalInfo_ = struct("action_msgs.msg.dds_.GoalInfo_", goal_id=UUID_, stamp=Time_)
CancelRequest_ = struct(
    "action_msgs.srv.dds_.CancelGoal_Request_", guid=uint64, seq=int64, goal_info=GoalInfo_
)
CancelResponse_ = struct(
    "action_msgs.srv.dds_.CancelGoal_Response_",
    guid=uint64,
    seq=int64,
    return_code=int8,
    goals_canceling=sequence[GoalInfo_],
)


def action_of(prefix: str, goal: Any, result: Any) -> tuple[Any, ...]:
    """Return request and reply of an action's services `send_goal` and `get_result`."""
    call = {"guid": uint64, "seq": int64}
    return (
        struct(prefix + "SendGoal_Request_", **call, goal_id=UUID_, goal=goal),
        struct(prefix + "SendGoal_Response_", **call, accepted=bool, stamp=Time_),
        struct(prefix + "GetResult_Request_", **call, goal_id=UUID_),
        struct(prefix + "GetResult_Response_", **call, status=int8, result=result),
    )


def topics(participant: DomainParticipant, path: str, request: type, response: type) -> list[Topic]:
    """The topics of a service: of its requests, and of its replies."""
    return [
        Topic(participant, f"rq{path}Request", request),
        Topic(participant, f"rr{path}Reply", response),
    ]


def server_of(participant: DomainParticipant, path: str, *types: type) -> tuple[Any, Any]:
    """A service's server: what reads requests, and what writes replies."""
    asked, told = topics(participant, path, *types)
    return DataReader(participant, asked, qos=QUALITY), DataWriter(participant, told, qos=QUALITY)


def client_of(participant: DomainParticipant, path: str, *types: type) -> tuple[Any, Any]:
    """A service's client: what reads replies, and what writes requests."""
    asked, told = topics(participant, path, *types)
    return DataReader(participant, told, qos=QUALITY), DataWriter(participant, asked, qos=QUALITY)


def valid(reader: Any) -> list[Any]:
    return [sample for sample in reader.take(N=10) if sample.sample_info.valid_data]


GoalStatus_ = struct("action_msgs.msg.dds_.GoalStatus_", goal_info=GoalInfo_, status=int8)
GoalStatusArray_ = struct(
    "action_msgs.msg.dds_.GoalStatusArray_", status_list=sequence[GoalStatus_]
)


class Commander:
    """The client's side of the action."""

    def __init__(
        self, domain: int, name: str, prefix: str, goal: Any, result: Any, feedback: Any
    ) -> None:
        participant, path = DomainParticipant(domain), f"{name}/_action/"
        self.participant, self.path, self._goal = participant, path, goal
        self._kinds = action_of(prefix, goal, result)
        self._send = client_of(participant, path + "send_goal", *self._kinds[:2])
        self._result = client_of(participant, path + "get_result", *self._kinds[2:])
        self._cancel = client_of(participant, path + "cancel_goal", CancelRequest_, CancelResponse_)
        message = struct(prefix + "FeedbackMessage_", goal_id=UUID_, feedback=feedback)
        self._feedback = DataReader(
            participant, Topic(participant, f"rt{path}feedback", message), qos=QUALITY
        )
        status = Topic(participant, f"rt{path}status", GoalStatusArray_)
        self._status = DataReader(participant, status, qos=LATCHED)
        self._asked = 0

    async def call(self, service: tuple[Any, Any], request: type, *fields: Any) -> Any:
        """Ask once server and client see each other, and wait for the reply."""
        reader, writer = service
        async with asyncio.timeout(PATIENCE_S):
            while not (
                writer.get_publication_matched_status().current_count
                and reader.get_subscription_matched_status().current_count
            ):
                await asyncio.sleep(0.01)
            self._asked += 1
            number = self._asked
            writer.write(request(7, number, *fields))
            while True:
                for reply in valid(reader):
                    if (reply.guid, reply.seq) == (7, number):
                        return reply
                await asyncio.sleep(0.01)

    async def send(self, *fields: Any) -> UUID_ | None:
        """Send a goal; None: it was rejected."""
        goal_id = UUID_(uuid.uuid4().bytes)
        told = await self.call(self._send, self._kinds[0], goal_id, self._goal(*fields))
        return goal_id if told.accepted else None

    async def ended(self, goal_id: UUID_) -> Any:
        return await self.call(self._result, self._kinds[2], goal_id)

    async def canceled(self, goal_id: UUID_) -> Any:
        return await self.call(self._cancel, CancelRequest_, GoalInfo_(goal_id, Time_(0, 0)))

    async def heard(self, goal_id: UUID_) -> Any:
        """Feedback on a goal, as it comes."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                for message in valid(self._feedback):
                    if message.goal_id == goal_id:
                        return message.feedback
                await asyncio.sleep(0.01)

    async def type_hashes(self, count: int) -> dict[str, bytes]:
        """Return what the server's endpoints tell of their types, by topic, once there are so
        many: as `ros2 topic info -v` finds it."""
        told: dict[str, bytes] = {}
        async with asyncio.timeout(PATIENCE_S):
            while len(told) < count:
                for topic in (BuiltinTopicDcpsPublication, BuiltinTopicDcpsSubscription):
                    for sample in BuiltinDataReader(self.participant, topic).take(N=100):
                        name, quality = sample.topic_name, sample.qos
                        if self.path in (name or "") and Policy.Userdata in quality:
                            told[name] = quality[Policy.Userdata].data
                await asyncio.sleep(0.01)
        return told

    async def nodes(self) -> dict[str, tuple[int, int, bool]]:
        """Return the nodes that participants tell of: how many readers and writers each has, and
        whether all of these endpoints and the participant were discovered."""
        topic = Topic(self.participant, "ros_discovery_info", ParticipantEntitiesInfo_)
        reader: Any = DataReader(self.participant, topic, qos=LATCHED)
        async with asyncio.timeout(PATIENCE_S):
            while not (told := valid(reader)):
                await asyncio.sleep(0.01)
        seen = {
            sample.key.bytes
            for builtin in (
                BuiltinTopicDcpsParticipant,
                BuiltinTopicDcpsPublication,
                BuiltinTopicDcpsSubscription,
            )
            for sample in BuiltinDataReader(self.participant, builtin).read(N=1000)
        }
        found = {}
        for info in told:
            for node in info.node_entities_info_seq:
                gids = [info.gid, *node.reader_gid_seq, *node.writer_gid_seq]
                known = {bytes(gid.data) for gid in gids} <= seen
                counts = len(node.reader_gid_seq), len(node.writer_gid_seq)
                found[node.node_namespace + node.node_name] = (*counts, known)
        return found

    async def status(self, goal_id: UUID_, expected: int) -> None:
        """Wait until the status topic says so."""
        async with asyncio.timeout(PATIENCE_S):
            while True:
                for message in valid(self._status):
                    found = {bytes(s.goal_info.goal_id.uuid): s.status for s in message.status_list}
                    if found.get(bytes(goal_id.uuid)) == expected:
                        return
                await asyncio.sleep(0.01)
