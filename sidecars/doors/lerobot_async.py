"""lerobot's asynchronous inference at a unix socket: gRPC, for its `robot_client` as it is.

Each connection is one robot, known by the name of its end (`sidecars.port`). gRPC gives the clients
of one process one connection, and so one robot. Differences to lerobot's server: several robots at
once; a policy is chosen from what is offered, never loaded from where a robot says; pickles are
read as data (`pickles`); what fails is told. Statuses are such that gRPC's clients do not repeat
the request behind the robot's back.
"""

import asyncio
import contextlib
import functools
import logging
import runpy
from collections.abc import AsyncIterable, AsyncIterator, Callable, Mapping
from importlib.metadata import distribution
from pathlib import Path
from types import SimpleNamespace
from typing import Any, Final

import grpc
import grpc.aio

from vram_arbiter.clients.net.server import IMAGES_MAX_BYTES
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import (
    BadRequest,
    BadState,
    CallerError,
    FrameStale,
    LimitExceeded,
    MessageTooLarge,
    ModelError,
    OutOfMemory,
    UnknownSkill,
    VramError,
)
from vram_arbiter.sidecars.doors.lerobot_messages import (
    instructions_of,
    observation_of,
    pickled_actions,
)
from vram_arbiter.sidecars.doors.offers import Offers
from vram_arbiter.sidecars.doors.robot import Robot
from vram_arbiter.sidecars.port import Conduct

SERVICE: Final = "transport.AsyncInference"
WAIT_S: Final = 2.0
"""How long a request for actions waits for an observation, as at lerobot's server."""
STREAM_S: Final = 10.0  # how long one observation may take to arrive
BEGIN_S: Final = 0.2  # of a request that a robot sends once: the next one comes no sooner
CHUNKS_MAX: Final = 64  # of one observation: lerobot's are of 2 MiB, but for the last
REQUESTS_MAX: Final = 256  # at a time, of all robots
MESSAGE_MAX_BYTES: Final = 4 * MIB  # lerobot's clients send 2 MiB at most
INSTRUCTIONS_MAX_BYTES: Final = 64 * 1024
DETAILS_MAX_CHARS: Final = 1000  # they travel in a header
_OPTIONS: Final = (
    ("grpc.max_receive_message_length", MESSAGE_MAX_BYTES),
    ("grpc.max_concurrent_streams", 3),  # a robot has two
    ("grpc.http2.bdp_probe", 0),  # else it reads megabytes ahead of each stream
    ("grpc.server_handshake_timeout_ms", 5000),
    ("grpc.max_connection_idle_ms", 600_000),
)
_STATUSES: Final[Mapping[type[VramError], grpc.StatusCode]] = {
    BadRequest: grpc.StatusCode.INVALID_ARGUMENT,
    BadState: grpc.StatusCode.FAILED_PRECONDITION,
    UnknownSkill: grpc.StatusCode.NOT_FOUND,
    LimitExceeded: grpc.StatusCode.RESOURCE_EXHAUSTED,
    MessageTooLarge: grpc.StatusCode.RESOURCE_EXHAUSTED,
    OutOfMemory: grpc.StatusCode.RESOURCE_EXHAUSTED,
    ModelError: grpc.StatusCode.INTERNAL,
}
"""All others: ABORTED. A client repeats UNAVAILABLE and DEADLINE_EXCEEDED without a word."""
_ENDS: Final = Path("/proc/self/net/unix")
_BEGIN, _END = 1, 3  # of TransferState
_log = logging.getLogger("sidecars")


@contextlib.asynccontextmanager
async def served(path: Path, offers: Offers, conduct: Conduct) -> AsyncIterator[None]:
    """Serve at the unix socket `path` within the block, and judge what comes for its `conduct`."""
    server = grpc.aio.server(options=_OPTIONS, maximum_concurrent_rpcs=REQUESTS_MAX)
    server.add_generic_rpc_handlers((_handlers(_Door(offers, conduct)),))
    server.add_insecure_port(f"unix:{path}")
    await server.start()
    try:
        yield
    finally:
        await server.stop(None)


class _Door:
    def __init__(self, offers: Offers, conduct: Conduct) -> None:
        self._offers = offers
        self.conduct = conduct
        self._robots: dict[str, Robot] = {}  # by the name of their end
        self._messages = _messages()

    async def ready(self, request: Any, context: Any) -> Any:
        await asyncio.sleep(BEGIN_S)
        return self._messages.Empty()

    async def instruct(self, request: Any, context: Any) -> Any:
        """Choose the skill that a robot asks for, and load it, as lerobot's server does."""
        if len(request.data) > INSTRUCTIONS_MAX_BYTES:
            raise LimitExceeded(f"instructions of more than {INSTRUCTIONS_MAX_BYTES} bytes")
        await asyncio.sleep(BEGIN_S)
        asked = instructions_of(request.data)
        sidecar = await self._offers.find(asked.skill)
        await sidecar.load()
        self._forget_gone()
        self._robots[context.peer()] = Robot(asked, sidecar)
        _log.info("%s asks for %s", context.peer(), asked.skill)
        return self._messages.Empty()

    def _forget_gone(self) -> None:
        """Forget robots whose connection has ended, which gRPC does not tell: the kernel lists the
        names of all ends."""
        ends = set(_ENDS.read_text(encoding="ascii", errors="replace").split())
        gone = [peer for peer in self._robots if f"@{_end(peer)}" not in ends]
        for peer in gone:
            del self._robots[peer]

    async def observe(self, chunks: AsyncIterable[Any], context: Any) -> Any:
        robot = self._robot(context)
        try:
            async with asyncio.timeout(STREAM_S), robot.receiving:
                data = await _joined(chunks)
                robot.offer(observation_of(data, robot.asked))
                self.conduct.served(_end(context.peer()), len(data))
        except TimeoutError:
            raise LimitExceeded(f"it takes longer than {STREAM_S:g} s", hint="send less") from None
        return self._messages.Empty()

    async def get_actions(self, request: Any, context: Any) -> Any:
        """Answer the actions after the observation in the robot's queue; none where there is no
        observation, or it became too old while its model was loaded."""
        robot = self._robot(context)
        async with robot.turn:
            if not await robot.arrival(WAIT_S):
                return self._messages.Actions()
            try:
                observation, rows = await robot.act()
            except FrameStale as error:
                _log.info("%s: %s", context.peer(), error)
                return self._messages.Actions()
        return self._messages.Actions(data=pickled_actions(observation, rows))

    def _robot(self, context: Any) -> Robot:
        robot = self._robots.get(context.peer())
        if robot is None:
            raise BadState(
                "this connection has sent no instructions",
                hint="start the robot client again: it sends them first",
            )
        return robot


def _end(peer: str) -> str:
    """Return the name of a connection's end, of gRPC's name of the peer."""
    return peer.rpartition(":")[2]


async def _joined(chunks: AsyncIterable[Any]) -> bytes:
    """Return the bytes of one observation. Raises BadRequest, LimitExceeded."""
    parts: list[bytes] = []
    try:
        async for chunk in chunks:
            if chunk.transfer_state == _BEGIN:
                parts.clear()
            parts.append(chunk.data)
            if len(parts) > CHUNKS_MAX or sum(map(len, parts)) > IMAGES_MAX_BYTES:
                raise LimitExceeded(
                    f"an observation of more than {IMAGES_MAX_BYTES} bytes or {CHUNKS_MAX} chunks",
                    hint="send smaller pictures",
                )
            if chunk.transfer_state == _END:
                return b"".join(parts)
    finally:
        parts.clear()  # a refusal's traceback would hold them until the collector runs
    raise BadRequest("an observation without its end", hint="send what robot_client sends")


def _handlers(door: _Door) -> Any:
    unary, stream = grpc.unary_unary_rpc_method_handler, grpc.stream_unary_rpc_method_handler
    known = _messages()
    methods = {
        "Ready": (unary, door.ready, known.Empty, known.Empty),
        "SendPolicyInstructions": (unary, door.instruct, known.PolicySetup, known.Empty),
        "SendObservations": (stream, door.observe, known.Observation, known.Empty),
        "GetActions": (unary, door.get_actions, known.Empty, known.Actions),
    }
    return grpc.method_handlers_generic_handler(
        SERVICE,
        {
            name: make(_told(door, answer, reply), request.FromString, reply.SerializeToString)
            for name, (make, answer, request, reply) in methods.items()
        },
    )


def _told(door: _Door, answer: Callable[..., Any], reply: Callable[[], Any]) -> Callable[..., Any]:
    """Return a handler whose typed errors are statuses, with an empty `reply`."""

    async def answered(request: Any, context: Any) -> Any:
        try:
            return await answer(request, context)
        except VramError as error:  # its traceback holds what was sent: only words are kept
            status = _STATUSES.get(type(error), grpc.StatusCode.ABORTED)
            details = f"{error.code}: {error}"[:DETAILS_MAX_CHARS]
            if isinstance(error, CallerError):
                door.conduct.refused(_end(context.peer()))
        context.set_code(status)  # `abort` would keep the request until the collector runs
        context.set_details(details)
        return reply()

    return answered


@functools.cache
def _messages() -> Any:
    """Return lerobot's generated messages. Their package imports torch, which the host of a sidecar
    does without."""
    file = distribution("lerobot").locate_file("lerobot/transport/services_pb2.py")
    return SimpleNamespace(**runpy.run_path(str(file)))
