"""ROS 2's side of DDS: topic and type names, domain, quality of service. Needs no ROS installation.

Cyclone DDS chooses the network: `CYCLONEDDS_URI` configures it, as for ROS with rmw_cyclonedds.
"""

from __future__ import annotations

import dataclasses
import functools
import os
import re
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any

from vram_arbiter.schemas.errors import ConfigError

PLAIN_CDR = (0, 1, 6, 7)  # CDR and CDR 2, both byte orders
DOMAIN_MAX = 232  # the last one whose ports exist
DOMAIN_VARIABLE = "ROS_DOMAIN_ID"
_NAME = re.compile(r"/?[A-Za-z_][A-Za-z0-9_]*(?:/[A-Za-z_][A-Za-z0-9_]*)*")


def full_topic(name: str) -> str:
    """Return the DDS topic of a ROS name with its leading slash.

    Raises ValueError for a wrong name.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(
            "expected a ROS topic (letters, digits and _ between slashes,"
            " such as /front/image_raw),"
            f" got {name!r}"
        )
    return "/" + name.removeprefix("/")


def dds_topic(name: str) -> str:
    """Return the DDS name of a ROS topic: `rt` for topic, then the full name."""
    return "rt" + full_topic(name)


def domain_of(environment: Mapping[str, str] = os.environ) -> int:
    """Return the domain of the environment; 0 without one. Raises ValueError."""
    text = environment.get(DOMAIN_VARIABLE, "") or "0"
    if not text.isascii() or not text.isdigit() or int(text) > DOMAIN_MAX:
        raise ValueError(f"{DOMAIN_VARIABLE} is {text!r}, not a number from 0 to {DOMAIN_MAX}")
    return int(text)


def as_bytes(made: Any) -> Any:
    """Let the samples of a DDS type stay as bytes (`cdr_of`, `sample_of`), and return the type."""
    made.deserialize = staticmethod(lambda data, *_, **__: sample_of(made, bytes(data)))
    made.serialize = lambda self, *_, **__: cdr_of(self)
    return made


@functools.cache
def topic_type(message: Any) -> Any:
    """Return the type of a topic of these IDL messages; its samples stay as bytes.

    Cyclone's description of a type knows `bytes` as a sequence only.
    """
    from cyclonedds.idl import make_idl_struct
    from cyclonedds.idl.types import sequence, uint8

    members = {
        one.name: sequence[uint8] if one.type is bytes else one.type
        for one in dataclasses.fields(message)
    }
    return as_bytes(make_idl_struct(message.__name__, message.__idl_typename__, members))


def parse[M](message: type[M], cdr: bytes) -> M:
    """Read plain CDR as one of Cyclone's IDL types. Raises ValueError."""
    if len(cdr) < 4 or cdr[0] != 0 or cdr[1] not in PLAIN_CDR:
        raise ValueError("the message is in an encoding other than plain CDR")
    try:
        read: M = message.__idl__.deserialize(cdr)  # type: ignore[attr-defined]
    except Exception as error:  # whatever Cyclone's parser hits
        raise ValueError(f"the message cannot be read: {error}") from error
    return read


def written(message: Any) -> bytes:
    """Return one of Cyclone's IDL messages as plain CDR, as ROS writes it."""
    cdr: bytes = message.serialize(use_version_2=False)
    return cdr


def sample_of(dds_type: Any, cdr: bytes) -> Any:
    """Return a sample of that type with these bytes."""
    sample = dds_type.__new__(dds_type)
    sample.cdr = cdr
    return sample


def cdr_of(sample: Any) -> bytes:
    """Return the bytes of a received sample, or of one made by `sample_of`."""
    cdr: bytes = sample.cdr
    return cdr


def qos_of(
    reliability: str, *, writer: bool, kept: int = 1, wait_s: int = 0, latched: bool = False
) -> Any:
    """Return ROS's quality of service: the newest `kept` samples, plain CDR.

    A writer waits `wait_s` for a slow reader at most; then it drops. `latched`: readers that come
    later get what was kept; otherwise nothing is.
    """
    from cyclonedds.core import Policy, Qos
    from cyclonedds.util import duration

    reliable = Policy.Reliability.Reliable(duration(seconds=wait_s))
    return Qos(
        reliable if reliability == "reliable" else Policy.Reliability.BestEffort,
        Policy.Durability.TransientLocal if latched else Policy.Durability.Volatile,
        Policy.History.KeepLast(kept),
        Policy.DataRepresentation(use_cdrv0_representation=True),
        *(
            (Policy.WriterDataLifecycle(autodispose=False),) if writer else ()
        ),  # ROS disposes of nothing
    )


@contextmanager
def dds_problems(domain_id: int) -> Iterator[None]:
    """Turn DDS's errors into ConfigError: no such interface, a broken CYCLONEDDS_URI, no free
    port.
    """
    from cyclonedds.core import DDSException

    try:
        yield
    except DDSException as error:
        raise ConfigError(
            f"DDS could not be started on domain {domain_id}: {error}",
            hint="look at CYCLONEDDS_URI: its interfaces and peers; Cyclone logs details on stderr",
        ) from error
