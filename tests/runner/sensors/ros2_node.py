"""A ROS-like node on types and codec of Cyclone DDS alone: nothing of the product is imported."""

from typing import Any

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import make_idl_struct
from cyclonedds.idl.types import int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

from tests.support.waiting import until


def struct(typename: str, **members: Any) -> Any:
    """Return an IDL type, by Cyclone's own means."""
    return make_idl_struct(typename.rpartition(".")[2], typename, members)


Time_ = struct("builtin_interfaces.msg.dds_.Time_", sec=int32, nanosec=uint32)
Header_ = struct("std_msgs.msg.dds_.Header_", stamp=Time_, frame_id=str)
Image_ = struct(
    "sensor_msgs.msg.dds_.Image_",
    header=Header_,
    height=uint32,
    width=uint32,
    encoding=str,
    is_bigendian=uint8,
    step=uint32,
    data=sequence[uint8],
)
CompressedImage_ = struct(
    "sensor_msgs.msg.dds_.CompressedImage_", header=Header_, format=str, data=sequence[uint8]
)
KINDS = {"image": Image_, "compressed": CompressedImage_}


class Node:
    """A participant of its own that publishes pictures on a topic, or takes them."""

    def __init__(self, domain: int, topic: str, message: str, reliability: str) -> None:
        self.kind = KINDS[message]
        self.qos = Qos(
            Policy.Reliability.Reliable(duration(seconds=10))
            if reliability == "reliable"
            else Policy.Reliability.BestEffort,
            Policy.History.KeepLast(5),
            Policy.DataRepresentation(use_cdrv0_representation=True),
        )
        self.participant: Any = DomainParticipant(domain)
        self.topic: Any = Topic(self.participant, "rt" + topic, self.kind)
        self.writer: Any = None

    def offer(self) -> "Node":
        self.writer = DataWriter(self.participant, self.topic, qos=self.qos)
        return self

    def publish(self, data: bytes, stamp_ns: int, **fields: Any) -> None:
        """Write one picture, once a reader is there."""
        until(lambda: self.writer.get_publication_matched_status().current_count)
        header = Header_(Time_(*divmod(stamp_ns, 10**9)), "cam")
        self.writer.write(self.kind(header=header, data=list(data), **fields))

    def take(self) -> Any:
        """Return the next picture that comes, at most in a minute."""
        reader = DataReader(self.participant, self.topic, qos=self.qos)
        return next(reader.take_iter(timeout=duration(seconds=60)))

    def close(self) -> None:
        """Leave the domain."""
        self.writer = self.topic = self.participant = None
