"""`vramctl status` and `why` on the shortest way: one blocking DEALER, two messages, two answers.

An operator types these a hundred times, scripts poll them: the path imports zmq and msgpack and nothing heavier (no pydantic, asyncio,
typer, rich, OpenTelemetry; a test holds it to that). Output and exit codes are the same as through `clients.cli.app`.
"""

import json
import os
import sys
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from typing import Any

from clients.cli import text
from clients.packing import pack
from schemas.defaults import WIRE_VERSION
from schemas.endpoints import arbiter_endpoint

OK, NO, USAGE, UNREACHABLE = 0, 1, 2, 3
"""Exit codes of `vramctl`: done; the answer is no, or an error; wrong usage; the arbiter cannot be reached."""

TIMEOUT_S = 3.0
DOUBT_MS = 200
"""An arbiter answers within a few; after so long it is looked whether there is one."""
HANGS = "something holds the socket and is silent: look at the arbiter's log, or set VRAM_ARBITER_ENDPOINT"
ENVELOPE = frozenset({"re", "ok"})

Message = dict[str, Any]


class Unreachable(Exception):
    """Nobody answers; the text says where, `hint` what to do."""

    def __init__(self, message: str, hint: str) -> None:
        super().__init__(message)
        self.hint = hint


def ask(
    op: str,
    fields: Mapping[str, Any],
    endpoint: str | None = None,
    timeout_s: float = TIMEOUT_S,
    role: str = "observer",
) -> Message:
    """Hello, then one request. Returns its reply, error replies too. Raises Unreachable."""
    import msgpack
    import zmq

    where = endpoint or arbiter_endpoint(os.environ, os.getuid())
    if where.startswith("ipc://") and not os.path.exists(where.removeprefix("ipc://")):
        _look(where)
    context = zmq.Context()
    socket = context.socket(zmq.DEALER)
    try:
        socket.setsockopt(zmq.LINGER, 0)
        try:
            socket.connect(where)
        except zmq.ZMQError as error:
            _look(where)
            hint = (
                "set VRAM_ARBITER_ENDPOINT to where it serves, such as ipc:///run/vram-arbiter/arbiter.sock"
            )
            raise Unreachable(f"{where} is no endpoint: {error.strerror}", hint) from error
        hello = {
            "op": "hello",
            "id": 1,
            "version": WIRE_VERSION,
            "name": "vramctl",
            "instance": f"vramctl-{os.getpid()}",
        }
        for message in (hello | {"role": role}, {"op": op, "id": 2, **fields}):
            socket.send(pack(message))
        deadline = time.monotonic() + timeout_s
        if not socket.poll(min(DOUBT_MS, int(1000 * timeout_s))):
            _look(where)
        while socket.poll(max(0, int(1000 * (deadline - time.monotonic())))):
            reply: Message = msgpack.unpackb(socket.recv(), strict_map_key=False)
            if reply.get("re") == 2 or (reply.get("re") == 1 and not reply.get("ok")):
                return reply
        raise Unreachable(f"no arbiter answers at {where} within {timeout_s:g} s", HANGS)
    finally:
        socket.close()
        context.term()


def _look(where: str) -> None:
    """Raises Unreachable if the kernel knows at once why nobody answers."""
    from clients.reach import obstacle

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
            "code": "arbiter_unreachable",
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
        print(json.dumps({key: value for key, value in reply.items() if key not in hidden}, indent=2))
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
        "status", {}, endpoint=endpoint, as_json=as_json, lines=text.status_lines, question=_all_pages
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
