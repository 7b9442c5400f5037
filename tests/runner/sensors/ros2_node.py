"""A ROS-like node in a process of its own, with types and codec of Cyclone DDS alone: nothing of
the product is imported here.

python ros2_node.py publish|subscribe TOPIC image|compressed reliable|best_effort

`publish` reads one picture a line as JSON and writes it: fields of the message, `stamp` in seconds
and nanoseconds, `data` in base64. Before the first it waits for a reader, unless asked not to
(`"wait": false`). `subscribe` prints the pictures that come in, as such lines. Both say `ready`
first and end with their standard input.
"""

import base64
import json
import os
import sys
import threading
from dataclasses import dataclass

from cyclonedds.core import DDSStatus, Policy, Qos, WaitSet
from cyclonedds.domain import DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.annotations import final
from cyclonedds.idl.types import int32, sequence, uint8, uint32
from cyclonedds.pub import DataWriter
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration


@dataclass
@final
class Time_(IdlStruct, typename="builtin_interfaces.msg.dds_.Time_"):
    sec: int32
    nanosec: uint32


@dataclass
@final
class Header_(IdlStruct, typename="std_msgs.msg.dds_.Header_"):
    stamp: Time_
    frame_id: str


@dataclass
@final
class Image_(IdlStruct, typename="sensor_msgs.msg.dds_.Image_"):
    header: Header_
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
@final
class CompressedImage_(IdlStruct, typename="sensor_msgs.msg.dds_.CompressedImage_"):
    header: Header_
    format: str
    data: sequence[uint8]


def say(**line: object) -> None:
    print(json.dumps(line), flush=True)


def publish(participant: DomainParticipant, topic: Topic, kind: type, qos: Qos) -> None:
    writer = DataWriter(participant, topic, qos=qos)
    writer.set_status_mask(DDSStatus.PublicationMatched)
    waitset = WaitSet(participant)
    waitset.attach(writer)
    say(ready=True)
    for line in sys.stdin:
        fields = json.loads(line)
        if fields.pop("wait", True):
            while not writer.get_publication_matched_status().current_count:
                waitset.wait(duration(seconds=1))
                writer.take_status(DDSStatus.PublicationMatched)
        header = Header_(Time_(*fields.pop("stamp")), fields.pop("frame_id", "cam"))
        data = list(base64.b64decode(fields.pop("data")))
        writer.write(kind(header=header, data=data, **fields))
        say(sent=True)


def subscribe(participant: DomainParticipant, topic: Topic, qos: Qos) -> None:
    reader = DataReader(participant, topic, qos=qos)
    say(ready=True)
    ended = threading.Event()
    threading.Thread(target=lambda: (sys.stdin.read(), ended.set()), daemon=True).start()
    while not ended.is_set():
        for sample in reader.take_iter(timeout=duration(milliseconds=100)):
            fields = {
                k: v for k, v in vars(sample).items() if k not in ("header", "data", "sample_info")
            }
            stamp = sample.header.stamp
            data = base64.b64encode(bytes(sample.data)).decode()
            say(
                stamp=[stamp.sec, stamp.nanosec],
                frame_id=sample.header.frame_id,
                data=data,
                **fields,
            )


def main() -> None:
    what, name, message, reliability = sys.argv[1:]
    kind = Image_ if message == "image" else CompressedImage_
    qos = Qos(
        Policy.Reliability.Reliable(duration(seconds=10))
        if reliability == "reliable"
        else Policy.Reliability.BestEffort,
        Policy.History.KeepLast(5),
        Policy.DataRepresentation(use_cdrv0_representation=True),
    )
    participant = DomainParticipant(int(os.environ["ROS_DOMAIN_ID"]))
    topic = Topic(participant, "rt" + name, kind)
    if what == "publish":
        publish(participant, topic, kind, qos)
    else:
        subscribe(participant, topic, qos)


main()
