"""lerobot's stock robot_client at a sidecar's door, unmodified, with a robot of this test."""

import dataclasses
import importlib
import os
import pickle
import re
import socket
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest

from tests.sidecars.doors.conftest import GRAB, Served
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.sidecars.doors.open import CONNECTIONS_MAX
from vram_arbiter.sidecars.weights import Weights, read_config

pytestmark = [pytest.mark.heavy, pytest.mark.e2e, pytest.mark.timeout(400)]
CHUNK = 12


@pytest.fixture
def door(doors: dict[str, Served]) -> Served:
    return doors["lerobot"]


@pytest.fixture
def make_client(lerobot: Any, door: Served, tmp_path: Path) -> Callable[..., Any]:
    def make(skill: str = GRAB, host: str = "127.0.0.1") -> Any:
        plugin = importlib.import_module("lerobot_robot_door")
        config = lerobot.RobotClientConfig(
            robot=plugin.DoorArmConfig(id="test", calibration_dir=tmp_path),
            server_address=f"{host}:{door.port}",
            policy_type="act",
            pretrained_name_or_path=skill,
            actions_per_chunk=CHUNK,
            task="grab the red cube",
        )
        return lerobot.RobotClient(config)

    return make


@contextmanager
def at_work(client: Any) -> Iterator[Any]:
    """A started client with its two threads, as its program runs them. Gives its robot."""
    assert client.start()
    threads = [
        threading.Thread(target=client.receive_actions),
        threading.Thread(target=client.control_loop, kwargs={"task": client.config.task}),
    ]
    for thread in threads:
        thread.start()
    try:
        yield client.robot
    finally:
        client.shutdown_event.set()
        for thread in threads:
            thread.join(PATIENCE_S)
        client.stop()


def plays_on(robot: Any, count: int = 2 * CHUNK) -> None:
    """Wait until the robot was sent so many actions more."""
    before = len(robot.sent)
    until(lambda: len(robot.sent) > before + count, PATIENCE_S)


def test_a_robot_plays_the_policys_actions(make_client: Callable[..., Any], door: Served) -> None:
    client = make_client()
    first = client.robot.get_observation() | {"task": client.config.task}
    with at_work(client) as robot:
        plays_on(robot)
    names = list(robot.action_features)
    values = {"observation.state": [first[name] for name in names], "task": first["task"]}
    pictures = {f"observation.images.{name}": first[name] for name in ("front", "wrist")}
    answer = door.ask(
        endpoint="get_action", whole_chunk=True, data=npy.pack({"observation": values | pictures})
    )
    row = npy.unpack(answer["action"])[0].tolist()
    assert [robot.sent[0][name] for name in names] == row, "to the bit"


def test_actions_are_those_of_lerobots_own_server(
    lerobot: Any, make_client: Callable[..., Any]
) -> None:
    """`policy_server.py` on the same checkpoint and observation: numbers, times and time steps."""
    from lerobot.async_inference import helpers, policy_server
    from lerobot.async_inference.configs import PolicyServerConfig
    from lerobot.configs.policies import PreTrainedConfig
    from lerobot.policies import get_policy_class, make_pre_post_processors

    importlib.import_module("vram_arbiter.sidecars.models.compact_act")  # registers itself
    folder = str(Path(__file__).parents[3] / "configs/models/so101-grab")
    theirs = policy_server.PolicyServer(PolicyServerConfig())
    config = read_config(PreTrainedConfig, Weights(folder, local=True))
    theirs.policy = get_policy_class("compact_act").from_pretrained(folder, config=config)
    theirs.preprocessor, theirs.postprocessor = make_pre_post_processors(
        theirs.policy.config, pretrained_path=folder
    )
    client = make_client()
    theirs.lerobot_features = client.policy_config.lerobot_features
    theirs.actions_per_chunk = CHUNK
    raw = client.robot.get_observation() | {"task": "grab the red cube"}
    observation = helpers.TimedObservation(
        timestamp=time.time(), timestep=7, observation=raw, must_go=True
    )
    expected = theirs._predict_action_chunk(observation)
    assert client.start()
    assert client.send_observation(observation)
    empty = lerobot.services_pb2.Empty()
    ours = pickle.loads(client.stub.GetActions(empty).data)
    client.stop()
    for one, other in zip(ours, expected, strict=True):
        assert one.timestep == other.timestep
        assert one.timestamp == pytest.approx(other.timestamp, abs=1e-3)
        assert one.action.dtype == other.action.dtype
        assert one.action.tolist() == pytest.approx(other.action.tolist(), abs=1e-5)


def test_several_robots_are_served_at_once(make_client: Callable[..., Any]) -> None:
    """Also by the sidecar that is offered beside the door's own. gRPC gives clients of one process
    one connection, unless they name the host otherwise."""
    with ExitStack() as stack:
        robots = [
            stack.enter_context(at_work(make_client(skill, host)))
            for skill, host in (("models/so101-grab", "127.0.0.1"), ("second", "localhost"))
        ]
        for robot in robots:
            plays_on(robot, CHUNK)


def test_nothing_is_loaded_that_a_stranger_names(
    make_client: Callable[..., Any], door: Served, tmp_path: Path
) -> None:
    client = make_client("attacker/model")
    assert not client.start()
    client.stop()

    def asks_for(skill: str) -> Callable[[Peer], str]:
        config = dataclasses.replace(client.policy_config, pretrained_name_or_path=skill)
        return lambda peer: peer.instruct(config)

    skills = ("attacker/model", str(tmp_path), "../configs/models/so101-grab")
    for told in at_once(door.address, [asks_for(skill) for skill in skills]):
        assert told.startswith("NOT_FOUND: unknown_skill")
        assert f"is one of: {GRAB}" in told


def test_a_robot_waits_for_an_evicted_model_and_gets_no_old_actions(
    make_client: Callable[..., Any], door: Served
) -> None:
    client = make_client()
    with at_work(client) as robot:
        plays_on(robot)
        with door.evicted():
            until(lambda: client.action_queue.empty(), PATIENCE_S)
            sent = len(robot.sent)
            until(lambda: door.ask(endpoint="ping").get("wanted"), PATIENCE_S)
            assert len(robot.sent) == sent, "it holds"
        plays_on(robot)


# -- attackers


class Peer:
    """One bare gRPC client of the service."""

    def __init__(self, address: str) -> None:
        import grpc

        options = [("grpc.use_local_subchannel_pool", 1), ("grpc.enable_retries", 0)]
        self.channel = grpc.insecure_channel(address, options)
        services = importlib.import_module("lerobot.transport.services_pb2_grpc")
        self.messages = importlib.import_module("lerobot.transport.services_pb2")
        self.stub = services.AsyncInferenceStub(self.channel)

    def instruct(self, config: Any, **options: Any) -> str:
        data = config if isinstance(config, bytes) else pickle.dumps(config)
        setup = self.messages.PolicySetup(data=data)
        return self._status(lambda: self.stub.SendPolicyInstructions(setup, **options))

    def observe(self, chunks: Iterator[tuple[int, bytes]]) -> str:
        kind = self.messages.Observation
        return self._status(
            lambda: self.stub.SendObservations(
                kind(transfer_state=state, data=data) for state, data in chunks
            )
        )

    def _status(self, call: Callable[[], Any]) -> str:
        import grpc

        try:
            call()
        except grpc.RpcError as error:
            return f"{error.code().name}: {error.details()}"
        return "OK"


def at_once(address: str, attacks: Sequence[Callable[[Peer], str]]) -> list[str]:
    """Return what each attack was told, of a connection of its own: after a refusal it is not read
    for a second."""

    def alone(attack: Callable[[Peer], str]) -> str:
        peer = Peer(address)
        try:
            return attack(peer)
        finally:
            peer.channel.close()

    with ThreadPoolExecutor(len(attacks)) as pool:
        return list(pool.map(alone, attacks))


class Touches:
    def __init__(self, path: Path) -> None:
        self.path = path

    def __reduce__(self) -> Any:
        return os.system, (f"touch {self.path}",)


def test_attackers_are_refused_while_a_robot_is_served(
    make_client: Callable[..., Any], door: Served, tmp_path: Path
) -> None:
    import grpc

    from vram_arbiter.sidecars.doors.lerobot_async import CHUNKS_MAX

    client = make_client()
    mark = tmp_path / "ran"
    hostile, gzip = pickle.dumps(Touches(mark)), grpc.Compression.Gzip

    def instructed(data: bytes, count: int = 1) -> Callable[[Peer], str]:
        def attack(peer: Peer) -> str:
            assert peer.instruct(client.policy_config) == "OK"
            return peer.observe(iter([*[(2, data)] * count, (3, b"")]))

        return attack

    attacks: list[tuple[Callable[[Peer], str], str]] = [
        (lambda peer: peer.observe(iter([(3, b"")])), "FAILED_PRECONDITION: bad_state"),
        (lambda peer: peer.instruct(hostile), "INVALID_ARGUMENT.*names 'posix.system'"),
        (lambda peer: peer.instruct(b"\x80\x04" + b"]" * 32_000), "RESOURCE_EXHAUSTED"),
        (lambda peer: peer.instruct(b"no pickle"), "INVALID_ARGUMENT: bad_request"),
        (lambda peer: peer.instruct(pickle.dumps([1])), "INVALID_ARGUMENT: bad_request"),
        (lambda peer: peer.instruct(bytes(MIB)), "RESOURCE_EXHAUSTED: limit_exceeded: instr"),
        (lambda peer: peer.instruct(bytes(5 * MIB)), "RESOURCE_EXHAUSTED"),  # gRPC's own limit
        (
            lambda peer: peer.instruct(bytes(64 * MIB), compression=gzip),
            "RESOURCE_EXHAUSTED: Decompressed message",
        ),
        (instructed(hostile), "INVALID_ARGUMENT: bad_request: a pickle that names 'posix.system'"),
        (instructed(b"\x80\x04Nr\xff\xff\xff\x7fN."), "INVALID_ARGUMENT: bad_request"),
        (instructed(pickle.dumps({})), "INVALID.*expected a TimedObservation"),
        (instructed(bytes(2 * MIB), 9), "RESOURCE_EXHAUSTED: limit_exceeded: an observation of"),
        (instructed(b"", CHUNKS_MAX), "RESOURCE_EXHAUSTED: limit_exceeded: an observation of"),
    ]
    with at_work(client) as robot:
        plays_on(robot, CHUNK)
        before = door.rss_bytes()
        for told, expected in zip(
            at_once(door.address, [attack for attack, _ in attacks]),
            [expected for _, expected in attacks],
            strict=True,
        ):
            assert re.match(expected, told), told
        crowd = [
            socket.create_connection(("127.0.0.1", door.port)) for _ in range(4 * CONNECTIONS_MAX)
        ]
        plays_on(robot, CHUNK)
        for one in crowd:
            one.close()
        assert door.rss_bytes() - before < 128 * MIB
    assert not mark.exists()
    assert "Traceback" not in door.log.read_text()


@pytest.mark.nightly
def test_large_observations_that_are_refused_leave_nothing(
    make_client: Callable[..., Any], door: Served
) -> None:
    """Regression: tracebacks held what was refused until the collector ran: 3.4 GB of a dozen
    attackers. An observation may also stop in its midst, or never begin."""
    peer, over = Peer(door.address), threading.Event()
    assert peer.instruct(make_client().policy_config) == "OK"
    before = door.rss_bytes()
    size = 14 * MIB
    hostile = b"\x80\x04B" + size.to_bytes(4, "little") + bytes(size) + b"cos\nsystem\n."
    for _ in range(6):
        pieces = [hostile[at : at + 2 * MIB] for at in range(0, len(hostile), 2 * MIB)]
        told = peer.observe(iter([*((2, piece) for piece in pieces), (3, b"")]))
        assert "names 'os.system'" in told

    def endless(count: int) -> Iterator[tuple[int, bytes]]:
        yield from ((2, bytes(2 * MIB)) for _ in range(count))
        over.wait(PATIENCE_S)

    for count in (0, 7):
        assert "takes longer than" in peer.observe(endless(count))
    over.set()
    peer.channel.close()
    assert door.rss_bytes() - before < 128 * MIB
