"""openpi's websocket protocol at a unix socket, for its `openpi_client` as it is.

On connect the server sends metadata, then answers each observation with a chunk of actions, all as
msgpack maps; a text is an error, after which the client may go on. Read of openpi_client 0.1.2 and
openpi's `websocket_policy_server.py`. Differences to openpi's server: API keys are checked, sizes
are bounded, and while one observation is inferred, pings and other clients are answered.
"""

import asyncio
import contextlib
import hmac
import logging
import time
from collections.abc import AsyncIterator, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Final

import msgpack
from aiohttp import WSMessage, WSMsgType, web

from vram_arbiter.clients.net.server import IMAGES_MAX_BYTES
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import BadFrame, BadRequest, CallerError, InternalError, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.sidecars.doors.offers import FRESH_S
from vram_arbiter.sidecars.port import Conduct

STATE_ORDER: Final = "openpi_state"
"""Key of `policy_extras`: the names of the vectors that make up the state, in order."""
_LIMITS: Final = UnpackLimits(IMAGES_MAX_BYTES, values_max=1000, beside_binary_max_bytes=1 << 16)
"""An array has nine values."""
STATE_MAX: Final = 4096  # numbers of one vector: a picture's as a state are 700 ms of one core
_STATE, _IMAGES, _TASK = "observation.state", "observation.images.", "task"
_TEXTS: Final = ("prompt", "task")
_REASON_MAX_BYTES: Final = 123  # of a websocket's close
_log = logging.getLogger("sidecars")


@contextlib.asynccontextmanager
async def served(path: Path, door: "OpenpiDoor") -> AsyncIterator[None]:
    """Serve at the unix socket `path` within the block."""
    app = web.Application()
    app.add_routes([web.get("/healthz", _health), web.get("/{path:.*}", door.connect)])
    runner = web.AppRunner(app, handle_signals=False, access_log=None, shutdown_timeout=0.1)
    await runner.setup()
    try:
        await web.UnixSite(runner, str(path)).start()
        yield
    finally:
        await runner.cleanup()


async def _health(request: web.Request) -> web.Response:
    return web.Response(text="OK\n")


@dataclass(frozen=True, slots=True)
class OpenpiDoor:
    """What is served. `keys`: empty lets in clients without; `conduct` is told of each request."""

    sidecar: PolicyClient
    manifest: RSkillManifest
    keys: Sequence[bytes]
    conduct: Conduct

    async def connect(self, request: web.Request) -> web.StreamResponse:
        """Serve one client until it hangs up."""
        if self.keys and not self._knows(request.headers.get("Authorization", "")):
            return web.Response(status=401, text="the API key is missing or wrong\n")
        return await self._talk(request)

    def _knows(self, authorization: str) -> bool:
        given = authorization.removeprefix("Api-Key ").encode("utf-8", "surrogateescape")
        return any(hmac.compare_digest(given, key) for key in self.keys)

    async def _talk(self, request: web.Request) -> web.WebSocketResponse:
        """Read all the time, which answers pings: a client that has no answer to them hangs up."""
        socket = web.WebSocketResponse(compress=False, max_msg_size=IMAGES_MAX_BYTES)
        await socket.prepare(request)
        end = request.get_extra_info("peername").decode().lstrip("\0")
        work = asyncio.create_task(self._greet(socket), name="greet")
        try:
            async for message in socket:
                if not work.done():
                    await socket.close(code=1008, message=b"one observation at a time")
                    break
                work = asyncio.create_task(self._answer(socket, message, end), name="infer")
        finally:
            work.cancel()
            await asyncio.gather(work, return_exceptions=True)
        return socket

    async def _greet(self, socket: web.WebSocketResponse) -> None:
        """Load the model, then send the metadata: openpi's server listens once it has loaded."""
        try:
            await self.sidecar.load()
            await socket.send_bytes(msgpack.packb(metadata(self.manifest)))
        except VramError as error:
            reason = f"{error.code}: {error.message}".encode()[:_REASON_MAX_BYTES]
            await socket.close(code=1013, message=reason.decode(errors="ignore").encode())

    async def _answer(self, socket: web.WebSocketResponse, message: WSMessage, end: str) -> None:
        try:
            answer = await self._infer(message)
            self.conduct.served(end, len(message.data))
            await socket.send_bytes(answer)
        except VramError as error:
            if isinstance(error, CallerError):
                self.conduct.refused(end)
            await socket.send_str(f"{error.code}: {error}")
        except ConnectionError:
            pass  # it has hung up
        except Exception as error:  # noqa: BLE001  the outermost loop of a server
            _log.exception("internal error at the door")
            await socket.send_str(f"{InternalError.code}: {type(error).__name__}: see the log")

    async def _infer(self, message: WSMessage) -> bytes:
        """Return the answer to an observation. Raises FrameStale where no model began to look at it
        within `FRESH_S`, BadFrame, BadRequest, and what the sidecar raises."""
        if message.type is not WSMsgType.BINARY:
            raise BadFrame("expected a msgpack map, got a text", hint="send one msgpack map")
        began_s = time.monotonic()
        observation = observed(npy.unpack(unpack_map(message.data, _LIMITS)), self.manifest)
        answer = await self.sidecar.get_action(
            observation, whole_chunk=True, afresh=True, fresh_s=FRESH_S
        )
        took_ms = (time.monotonic() - began_s) * 1000
        packed: bytes = msgpack.packb(
            {"actions": npy.as_openpi(answer["action"]), "server_timing": {"infer_ms": took_ms}}
        )
        return packed


def metadata(manifest: RSkillManifest) -> Message:
    """Return what a client is told on connect; `reset_pose` is openpi's word."""
    found = {"skill": manifest.name, "version": manifest.version, "horizon": manifest.chunk_size}
    return found | ({"reset_pose": list(pose)} if (pose := manifest.starting_pose) else {})


def observed(raw: Message, manifest: RSkillManifest) -> Message:
    """Return what a policy sidecar takes of openpi's observation, whose maps may be nested.

    Only the last part of a name counts: a picture is the camera of that name, which the manifest's
    `aliases` map to the policy's; a lone vector, or the one called `state`, is the state, else the
    vectors of `policy_extras.openpi_state` one after another. Raises BadRequest.
    """
    found: Message = {}
    vectors: dict[str, Any] = {}
    for name, value in _leaves(raw):
        if isinstance(value, str):
            if name in _TEXTS:
                found[_TASK] = value
        elif getattr(value, "ndim", 0) == 3:
            found[_IMAGES + name] = _picture(value)
        else:
            vectors[name] = value
    return {**found, _STATE: _state(vectors, manifest.policy_extras.get(STATE_ORDER))}


def _leaves(raw: Mapping[Any, Any]) -> Iterator[tuple[str, Any]]:
    for key, value in raw.items():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield str(key).rpartition("/")[2], value


def _state(vectors: Mapping[str, Any], order: Any) -> Any:
    import numpy

    names = order if isinstance(order, list) else list(vectors) if len(vectors) == 1 else ["state"]
    if lacking := [str(name) for name in names if name not in vectors]:
        raise BadRequest(
            f"the observation has no {' and no '.join(lacking)}; its vectors are {list(vectors)}",
            hint=f"name those that make up the state in policy_extras.{STATE_ORDER}",
        )
    if long := [name for name in names if getattr(vectors[name], "size", 0) > STATE_MAX]:
        raise BadRequest(
            f"{long[0]} has more than {STATE_MAX} numbers", hint="pictures have 3 dimensions"
        )
    try:
        return numpy.concatenate([numpy.ravel(numpy.float32(vectors[name])) for name in names])
    except (TypeError, ValueError):
        raise BadRequest(f"{', '.join(names)} must be numbers", hint="send arrays") from None


def _picture(pixels: Any) -> Any:
    """Return a picture with its channels last; openpi's policies take them in front too."""
    return pixels.transpose(1, 2, 0) if pixels.shape[0] == 3 != pixels.shape[2] else pixels
