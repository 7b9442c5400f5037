"""An independent participant's side of a ROS 2 action: types and codec of Cyclone DDS alone."""

from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl.types import array, int8, int64, sequence, uint8, uint64
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.runner.sensors.ros2_node import Time_, struct

QUALITY = Qos(
    Policy.Reliability.Reliable(duration(seconds=10)),
    Policy.History.KeepLast(10),
    Policy.DataRepresentation(use_cdrv0_representation=True),
)
"""ROS 2's of services."""


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
