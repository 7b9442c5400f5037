"""One request to the arbiter and its reply, blocking: what a command that only asks needs.

It imports zmq and msgpack and nothing heavier: no pydantic, asyncio, anyio, rich or OpenTelemetry.
Operators type `vramctl status` often and scripts poll it; a test checks the imports.
"""

import contextlib
import os
import time
from typing import TYPE_CHECKING, Any

from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.errors import ArbiterUnreachable, from_wire
from vram_arbiter.schemas.plain import Message
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.msgpack_codec import pack
from vram_arbiter.schemas.wire import requests as w

if TYPE_CHECKING:
    import zmq

    from vram_arbiter.clients.net.link import Link

TIMEOUT_S = 3.0
DOUBT_S = 0.2
"""An arbiter answers within milliseconds; after so long the kernel is asked whether there
is one."""
RETRY_S = 0.02
HANGS = (
    "a program holds the socket but does not answer: look at the arbiter's log, or set "
    "VRAM_ARBITER_ENDPOINT"
)


def ask(
    request: w.Request[Any],
    endpoint: str | None = None,
    timeout_s: float = TIMEOUT_S,
    role: w.Role = "observer",
) -> Message:
    """Hello, then one request. Returns its reply, error replies too.

    Raises ArbiterUnreachable, UntrustedServer, and ConfigError for an endpoint that is not one.
    """
    import zmq

    deadline = time.monotonic() + timeout_s
    hello = w.Hello(name="vramctl", instance=f"vramctl-{os.getpid()}", role=role)
    where = endpoint or arbiter_endpoint(os.environ, os.getuid())
    late = f"no arbiter answers at {where} within {timeout_s:g} s"
    silent = ArbiterUnreachable(late, hint=HANGS)
    if where.startswith("ipc:///") and not os.path.exists(where.removeprefix("ipc://")):
        _look(where)
    with (
        zmq.Context() as context,
        contextlib.closing(_link(context, where, deadline, silent)) as link,
    ):
        for number, asked in enumerate((hello, request), 1):
            link.send(pack({**to_map(asked), "id": number}))
        return _reply(link, where, deadline, silent)


def checked(reply: Message) -> Message:
    """Return a reply. Raises the arbiter's error if it is a refusal."""
    if not reply.get("ok"):
        raise from_wire(reply["error"])
    return reply


def _link(
    context: "zmq.Context[zmq.Socket[bytes]]",
    where: str,
    deadline: float,
    silent: ArbiterUnreachable,
) -> "Link":
    """A link to an arbiter that may be believed. Raises ArbiterUnreachable, UntrustedServer,
    ConfigError."""
    from vram_arbiter.clients.net.link import Link

    while True:
        link = Link(context, where, "arbiter")
        try:
            if link.wait(deadline) == "open":
                return link
        except BaseException:
            link.close()
            raise
        link.close()
        _look(where)
        if time.monotonic() + RETRY_S >= deadline:
            raise silent
        time.sleep(RETRY_S)


def _reply(link: "Link", where: str, deadline: float, silent: ArbiterUnreachable) -> Message:
    """The reply to the request, or the refusal of the hello. Raises ArbiterUnreachable,
    UntrustedServer."""
    import msgpack
    import zmq

    from vram_arbiter.clients.net.link import ms_until

    poller = zmq.Poller()
    poller.register(link.socket, zmq.POLLIN)
    poller.register(link.monitor, zmq.POLLIN)
    if not poller.poll(min(int(1000 * DOUBT_S), ms_until(deadline))):
        _look(where)
    while poller.poll(ms_until(deadline)):
        ended = link.advance() == "ended"
        while (payload := link.receive()) is not None:
            reply: Message = msgpack.unpackb(payload, strict_map_key=False)
            if reply.get("re") == 2 or (reply.get("re") == 1 and not reply.get("ok")):
                return reply
        if ended:
            _look(where)
            told = f"the arbiter at {where} hung up"
            raise ArbiterUnreachable(told, hint="try again, or look at its log")
    raise silent


def _look(where: str) -> None:
    """Raise ArbiterUnreachable if the kernel knows at once why no arbiter answers."""
    from vram_arbiter.clients.net.diagnose import obstacle

    if found := obstacle(where):
        raise ArbiterUnreachable(found[0], hint=found[1])
