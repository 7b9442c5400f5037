"""`vramctl status` and `why` on the shortest way: one blocking DEALER, two messages, two answers.

An operator types these a hundred times, scripts poll them: the path imports zmq and msgpack and nothing heavier (no pydantic, asyncio,
typer, rich, OpenTelemetry; a test holds it to that). Output and exit codes are the same as through `clients.cli.app`.
"""

import contextlib
import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import TYPE_CHECKING, Any

from vram_arbiter.clients._protocol.codec import pack
from vram_arbiter.clients.cli import text
from vram_arbiter.schemas.defaults import WIRE_VERSION
from vram_arbiter.schemas.errors import UntrustedServer, VramError
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint

if TYPE_CHECKING:
    import zmq

    from vram_arbiter.clients.net.link import Link

OK, NO, USAGE, UNREACHABLE = 0, 1, 2, 3
"""Exit codes of `vramctl`: done; the answer is no, or an error; wrong usage; the arbiter cannot be reached."""

TIMEOUT_S = 3.0
DOUBT_S = 0.2
"""An arbiter answers within milliseconds; after so long the kernel is asked whether there is one."""
RETRY_S = 0.02
HANGS = "something holds the socket and is silent: look at the arbiter's log, or set VRAM_ARBITER_ENDPOINT"
ENVELOPE = frozenset({"re", "ok"})

Message = dict[str, Any]


class Unreachable(Exception):
    """No arbiter answers that may be believed; the text says where, `hint` what to do, `code` is that of the typed error."""

    def __init__(self, message: str, hint: str, code: str = "arbiter_unreachable") -> None:
        super().__init__(message)
        self.hint = hint
        self.code = code


def ask(
    op: str,
    fields: Mapping[str, Any],
    endpoint: str | None = None,
    timeout_s: float = TIMEOUT_S,
    role: str = "observer",
) -> Message:
    """Hello, then one request. Returns its reply, error replies too. Raises Unreachable."""
    import zmq

    deadline = time.monotonic() + timeout_s
    hello = {
        "op": "hello",
        "id": 1,
        "version": WIRE_VERSION,
        "name": "vramctl",
        "instance": f"vramctl-{os.getpid()}",
        "role": role,
    }
    try:
        where = endpoint or arbiter_endpoint(os.environ, os.getuid())
        silent = Unreachable(f"no arbiter answers at {where} within {timeout_s:g} s", HANGS)
        if where.startswith("ipc:///") and not os.path.exists(where.removeprefix("ipc://")):
            _look(where)
        with (
            zmq.Context() as context,
            contextlib.closing(_link(context, where, deadline, silent)) as link,
        ):
            for message in (hello, {"op": op, "id": 2, **fields}):
                link.send(pack(message))
            return _reply(link, where, deadline, silent)
    except VramError as error:
        code = error.code if isinstance(error, UntrustedServer) else "arbiter_unreachable"
        raise Unreachable(error.message, error.hint, code) from error


def _link(
    context: "zmq.Context[zmq.Socket[bytes]]", where: str, deadline: float, silent: Unreachable
) -> "Link":
    """A link to an arbiter that may be believed. Raises Unreachable, UntrustedServer, ConfigError."""
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


def _reply(link: "Link", where: str, deadline: float, silent: Unreachable) -> Message:
    """The reply to the request, or the refusal of the hello. Raises Unreachable, UntrustedServer."""
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
            raise Unreachable(f"the arbiter at {where} hung up", "try again, or look at its log")
    raise silent


def _look(where: str) -> None:
    """Raises Unreachable if the kernel knows at once why nobody answers."""
    from vram_arbiter.clients.net.diagnose import obstacle

    if found := obstacle(where):
        raise Unreachable(*found)


def answer(
    op: str,
    fields: Mapping[str, Any],
    *,
    endpoint: str | None,
    as_json: bool,
    lines: Callable[[Message], Sequence[str]],
    hidden: frozenset[str] = ENVELOPE,
    question: Callable[..., Message] = ask,
) -> tuple[int, Message]:
    """Ask, print, and say with which code to exit. `--json` prints the reply of `schemas.wire` without its envelope."""
    try:
        reply = question(op, fields, endpoint)
    except Unreachable as error:
        problem = {
            "code": error.code,
            "message": str(error),
            "hint": error.hint,
            "details": {},
        }
        complain(problem, as_json=as_json)
        return UNREACHABLE, {}
    if not reply.get("ok"):
        complain(reply["error"], as_json=as_json)
        return NO, {}
    if as_json:
        print(
            json.dumps({key: value for key, value in reply.items() if key not in hidden}, indent=2)
        )
    elif said := lines(reply):
        print("\n".join(said))
    return OK, reply


def complain(error: Mapping[str, Any], *, as_json: bool) -> None:
    """An error for programs on stdout, for people on stderr."""
    if as_json:
        print(json.dumps({"error": dict(error)}, indent=2))
    else:
        print(text.error_line(error), file=sys.stderr)


# -- commands ----------------------------------------------------------------------------------------------------------
def status(*, as_json: bool = False, endpoint: str | None = None) -> int:
    return answer(
        "status",
        {},
        endpoint=endpoint,
        as_json=as_json,
        lines=text.status_lines,
        question=_all_pages,
    )[0]


def _all_pages(op: str, fields: Mapping[str, Any], endpoint: str | None) -> Message:
    """The whole status: its leases come in pages."""
    reply = ask(op, fields, endpoint)
    after = reply.pop("next", None)
    while after is not None:
        page = ask(op, {**fields, "after": after}, endpoint)
        if not page.get("ok"):
            return page
        reply["leases"] += page["leases"]
        after = page.get("next")
    return reply


def why(consumer: str, *, as_json: bool = False, endpoint: str | None = None) -> int:
    """1 for a consumer that neither has a lease nor waits for one."""
    code, reply = answer(
        "why",
        {"consumer": consumer},
        endpoint=endpoint,
        as_json=as_json,
        lines=text.why_lines,
        hidden=ENVELOPE | {"epoch"},
    )
    return NO if code == OK and not reply["leases"] else code


def by_hand(
    action: str, fields: Mapping[str, Any], *, as_json: bool = False, endpoint: str | None = None
) -> int:
    """An operator's action: `evict`, `pin`, `unpin`, `release_dead` (fields target, reason), `drain`, `resume` (reason)."""
    return answer(
        action,
        fields,
        endpoint=endpoint,
        as_json=as_json,
        lines=lambda reply: text.by_hand_lines(action, reply),
        question=partial(ask, role="operator"),
    )[0]


def try_run(arguments: Sequence[str]) -> int | None:
    """Serve `status [--json]` and `why NAME [--json]` without an argument parser; None leaves everything else to it."""
    if not arguments or arguments[0] not in ("status", "why"):
        return None
    command, *rest = arguments
    as_json = "--json" in rest
    names = [item for item in rest if item != "--json"]
    if any(not name.isprintable() or name[:1] in ("", "-") for name in names) or len(names) != (
        command == "why"
    ):
        return None
    return status(as_json=as_json) if command == "status" else why(names[0], as_json=as_json)
