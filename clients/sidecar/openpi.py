"""Client of openpi's policy server (`serve_policy.py`): msgpack maps over a WebSocket.

For a policy skill it is a server of the field: without lease, `unload` and episodes. Read of
openpi's `websocket_policy_server.py`: on connect it sends metadata, then one answer for each
observation; a text is an error. A message that no request waits for ends the connection, and so
does a request that was given up: no old actions are ever taken for new ones.
"""

import asyncio
import re
from collections.abc import Callable, Iterator
from typing import TYPE_CHECKING, Any, Final
from urllib.parse import urlsplit

from vram_arbiter.clients.net.answer import Answer
from vram_arbiter.clients.sidecar import npy
from vram_arbiter.clients.sidecar.base import CALL_TIMEOUT_S
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import BadRequest, ConfigError, ModelError, UnknownOp, VramError
from vram_arbiter.schemas.plain import JsonMap, Message
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.msgpack_codec import UnpackLimits, unpack_map
from vram_arbiter.schemas.runtime.trust import check_uid, port_uids

if TYPE_CHECKING:
    import aiohttp

ANSWER_MAX_BYTES: Final = 4 * MIB
ERROR_MAX_CHARS: Final = 500  # of a text: the end of a traceback says most
_LIMITS: Final = UnpackLimits(ANSWER_MAX_BYTES)
_LEAF: Final = re.compile(
    r"(?P<name>task|observation\.(?:state|images\.[\w-]+))"
    r"(?:\[(?P<first>\d*):(?P<end>\d*)\])?(?P<chw> chw)?"
)
_HOSTS: Final = ("127.0.0.1", "localhost", "::1")


class Template:
    """What a server wants to see: a map whose leaves say what of an observation stands there.

    A leaf is `task`, `observation.state`, a part of it (`observation.state[:7]`) or a camera's
    picture (`observation.images.front`; ` chw` behind it puts the channels first).
    """

    def __init__(self, wanted: JsonMap) -> None:
        """Raises ValueError for a leaf that is none of them."""
        self._wanted = wanted
        self.names = {_parts(leaf)["name"] for leaf in _leaves(wanted)}

    def filled(self, observation: JsonMap) -> Message:
        """Return the observation as the server wants it. Raises BadRequest for what is missing."""
        if missing := sorted(self.names - observation.keys()):
            raise BadRequest(
                f"the observation has no {', '.join(missing)}", hint="see the manifest"
            )
        return _filled(self._wanted, observation)


def _leaves(wanted: JsonMap) -> Iterator[Any]:
    for value in wanted.values():
        if isinstance(value, dict):
            yield from _leaves(value)
        else:
            yield value


def _parts(leaf: Any) -> re.Match[str]:
    found = _LEAF.fullmatch(leaf) if isinstance(leaf, str) else None
    if found is None:
        raise ValueError(f"{leaf!r} is not task, observation.state or observation.images.CAMERA")
    return found


def _filled(wanted: JsonMap, observation: JsonMap) -> Message:
    return {
        key: _filled(value, observation) if isinstance(value, dict) else _value(value, observation)
        for key, value in wanted.items()
    }


def _value(leaf: str, observation: JsonMap) -> Any:
    found = _parts(leaf)
    value: Any = observation[found["name"]]
    if found["first"] is not None:
        value = value[int(found["first"] or 0) : int(found["end"]) if found["end"] else None]
    if found["chw"]:
        value = value.transpose(2, 0, 1)
    return value if isinstance(value, str) else npy.as_openpi(value)


class OpenpiClient(PolicyClient):
    """Client of the server at `ws://127.0.0.1:PORT`, which is shown what `template` says.

    A connection lasts from `load` until it fails or is closed. Raises ConfigError for an address
    that is not a WebSocket of this machine.
    """

    def __init__(
        self, endpoint: str, template: Template, *, timeout_s: float = CALL_TIMEOUT_S
    ) -> None:
        where = urlsplit(endpoint)
        if where.scheme != "ws" or where.hostname not in _HOSTS:
            raise ConfigError(
                f"a policy of openpi is served at ws://127.0.0.1:PORT, not at {endpoint}",
                hint="--sidecar RSKILL=ws://127.0.0.1:8000; ssh -L brings another machine's",
            )
        need("adapter: openpi", "aiohttp", "msgpack", extra="doors")
        # a gateway in front of the server starts it while it is connected to
        super().__init__(endpoint, timeout_s=timeout_s, connect_timeout_s=timeout_s)
        self._rpc = OpenpiLink(endpoint, template, self._lost)


class OpenpiLink:
    """One connection at a time, as `clients.net.rpc_client` has them. `lost` makes the error of a
    lost one."""

    in_order: Final = True

    def __init__(self, endpoint: str, template: Template, lost: Callable[[str], VramError]) -> None:
        self.proven = False
        self._endpoint = endpoint
        self._template = template
        self._lost = lost
        self._waiting: Answer[Message] | None = None
        self._running: asyncio.Task[None] | None = None
        self._socket: aiohttp.ClientWebSocketResponse | None = None

    async def exchange(self, request: JsonMap, timeout_s: float) -> Any:
        """Return the chunk as `action` for `get_action`; `ping` and `reset` need a connection
        alone, because its policies remember nothing.

        Raises: TimeoutError; UnknownOp for other requests; BadRequest for an observation that lacks
        something; ModelError for a text and for an answer that is not read; UntrustedServer; the
        error of `lost`.
        """
        if (op := request["endpoint"]) not in ("ping", "reset", "get_action"):
            raise UnknownOp(f"openpi's server has no {op}", hint="it ends as its own program does")
        if self._running is None:
            metadata = self._waiting = Answer()
            self._running = asyncio.create_task(self._run(), name="openpi's server")
            await metadata.within(timeout_s)
            self.proven = True
        if op != "get_action":
            return {}
        import msgpack

        sent = msgpack.packb(self._template.filled(npy.unpack(request["data"]["observation"])))
        answer = self._waiting = Answer()
        assert self._socket is not None, "it has sent its metadata"
        try:
            async with asyncio.timeout(timeout_s):
                await self._socket.send_bytes(sent)
                found = await answer.wait()
        except ConnectionError as error:
            raise self._lost(str(error)) from None
        if "actions" not in found:
            raise ModelError(f"the policy answered {sorted(map(str, found))}, no 'actions'")
        return {"action": found["actions"]}

    def drop(self, error: VramError) -> None:
        """End the connection; a request that waits fails with `error`. Idempotent."""
        running, self._running, self._socket = self._running, None, None
        waiting, self._waiting = self._waiting, None
        self.proven = False
        if running is not None:
            running.cancel()
        if waiting is not None:
            waiting.fail(error)

    async def _run(self) -> None:
        """Hear the server until it hangs up; pings are answered meanwhile."""
        import aiohttp

        try:
            async with (
                aiohttp.ClientSession() as session,
                session.ws_connect(self._endpoint, max_msg_size=ANSWER_MAX_BYTES) as self._socket,
            ):
                for uid in port_uids(self._socket.get_extra_info("socket")):
                    check_uid(uid, "sidecar", self._endpoint)
                async for message in self._socket:
                    self._heard(message.data)
            self.drop(self._lost("the server hung up"))
        except VramError as error:
            self.drop(error)
        except (aiohttp.ClientError, OSError) as error:
            self.drop(self._lost(str(error)))

    def _heard(self, data: Any) -> None:
        """Take a message for the answer that is awaited. Raises the error of `lost`."""
        waiting, self._waiting = self._waiting, None
        if waiting is None or not isinstance(data, str | bytes):
            raise self._lost(f"it sent {type(data).__name__} that nothing waits for")
        if isinstance(data, str):
            told = data[-ERROR_MAX_CHARS:].strip()
            waiting.fail(ModelError(f"the policy server failed: {told}", hint="see its log"))
            return
        try:
            waiting.set(npy.unpack(unpack_map(data, _LIMITS)))
        except VramError as error:
            waiting.fail(ModelError(f"the policy server's answer is not read: {error}"))
