"""Parsers of bytes that another user, machine or program wrote, in one table.

A target takes any bytes. It may raise the typed errors that its callers answer; anything else, and
more processor time than `try_input` allows, is a finding. `corpus/NAME/` has bytes of each target,
all made here: whole messages, known attacks, and what once broke a target.
"""

import functools
import tempfile
import time
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path

from tests.support.deployment import load_robot
from tests.support.hostile import code_of
from tests.support.paths import CONFIGS
from vram_arbiter.arbiter.eventlog.logfile import LogError, read_file
from vram_arbiter.arbiter.host.records import record_of
from vram_arbiter.arbiter.host.seal import Seal, read_last_start
from vram_arbiter.clients.net.server import parsed
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.runner.goals.server import OPS, RUNNER_REQUEST
from vram_arbiter.schemas import estop, strictjson
from vram_arbiter.schemas.config.arbiter import load_config
from vram_arbiter.schemas.config.gateway import load_gateway, load_keys
from vram_arbiter.schemas.config.observer import load_observer
from vram_arbiter.schemas.errors import BadFrame, CallerError, ConfigError, SidecarUnavailable
from vram_arbiter.schemas.manifest import (
    ManifestError,
    RSkillManifest,
    load_manifest,
    parse_manifest,
)
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.schemas.runtime.zmtp import ServerConnection, WireLimits, ZmtpError
from vram_arbiter.sidecars.doors import lerobot_messages as lerobot
from vram_arbiter.sidecars.doors.openpi import observed
from vram_arbiter.sidecars.gateway.routing import finder_of
from vram_arbiter.sidecars.gateway.upstream import read_head
from vram_arbiter.sidecars.wires import parse

CORPUS = Path(__file__).with_name("corpus")
LIMIT_S = 0.25
LIMIT_S_PER_BYTE = 20e-6
"""Processor time of one input: 0.25 s, and 20 s for each MB."""
LIMITS = UnpackLimits(values_max=1000)
ASKED = lerobot.Instructions("me/pick", ("a", "b"), {"observation.images.front": "front"}, 10)
MODEL_OPS = frozenset({"get_action", "reset", "detect", "query", "score"})


@dataclass(frozen=True, slots=True)
class Target:
    """`run` may raise `refuses` alone."""

    run: Callable[[bytes], object]
    refuses: type[Exception] | tuple[type[Exception], ...]


def try_input(target: Target, data: bytes) -> None:
    """Give a target bytes. Raises what is a finding."""
    began = time.process_time()
    try:
        target.run(data)
    except target.refuses:
        pass
    took = time.process_time() - began
    assert took <= LIMIT_S + LIMIT_S_PER_BYTE * len(data), f"{took:.3f} s for {len(data)} bytes"


def zmtp(data: bytes) -> None:
    connection = ServerConnection(WireLimits(message_max_bytes=1000, skip_max_bytes=4000))
    for part in (data[:100], data[100:]):
        connection.feed(part)
        while connection.next_event() is not None:
            connection.outgoing()
        assert connection.kept_bytes <= 1000 + len(part)


def stop(data: bytes) -> None:
    estop.reason_in(data)
    estop.reply_in(data)


def configuration(data: bytes) -> None:
    """The first line names the kind of the file."""
    kind, _, text = data.decode(errors="replace").partition("\n")
    readers: Mapping[str, Callable[[str, str], object]] = {
        "arbiter": load_config,
        "gateway": load_gateway,
        "keys": load_keys,
        "observer": load_observer,
    }
    readers.get(kind, load_robot)(text, "it.yaml")


def record(data: bytes) -> None:
    """The first line is the key."""
    key, _, text = data.decode(errors="replace").partition("\n")
    found = strictjson.loads(text)
    if isinstance(found, dict):
        record_of(key, found)


def state_files(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        (folder / "epoch").write_bytes(data)
        (folder / "journal.seal").write_bytes(data)
        try:
            read_last_start(folder)
        finally:
            Seal.read(folder)


def event_log(data: bytes) -> None:
    with tempfile.NamedTemporaryFile(suffix=".jsonl") as file:
        file.write(data)
        file.flush()
        read_file(Path(file.name))


def http_answer(data: bytes) -> None:
    head, _, rest = data.partition(b"\r\n\r\n")
    body = read_head(head + b"\r\n").body("GET", decoded=True)
    for part in (rest[:10], rest[10:]):
        assert len(body.take(part)) <= len(part) or not body.over


def http_body(data: bytes) -> None:
    """The first line is the content type."""
    kind, _, body = data.partition(b"\n")
    finder = finder_of(kind.decode("latin-1"), streams=True)
    if not finder.feed(body[:20]):
        finder.feed(body[20:])


@functools.cache
def a_manifest() -> RSkillManifest:
    return load_manifest(CONFIGS / "rskills/so101-grab/rskill.yaml")


TARGETS: Mapping[str, Target] = {
    "zmtp": Target(zmtp, ZmtpError),
    "request": Target(code_of, ()),
    "sidecar-request": Target(lambda data: parse(unpack_map(data, LIMITS), MODEL_OPS), CallerError),
    "goal-request": Target(
        lambda data: parsed(unpack_map(data, LIMITS), RUNNER_REQUEST, OPS), CallerError
    ),
    "estop": Target(stop, BadFrame),
    "manifest": Target(lambda data: parse_manifest(data).warnings(), ManifestError),
    "configuration": Target(configuration, ConfigError),
    "journal-record": Target(record, ValueError),
    "state-files": Target(state_files, ValueError),
    "event-log": Target(event_log, LogError),
    "http-answer": Target(http_answer, SidecarUnavailable),
    "http-body": Target(http_body, CallerError),
    "lerobot-policy": Target(lerobot.instructions_of, CallerError),
    "lerobot-observation": Target(lambda data: lerobot.observation_of(data, ASKED), CallerError),
    "openpi-observation": Target(
        lambda data: observed(npy.unpack(unpack_map(data, LIMITS)), a_manifest()), CallerError
    ),
}
