"""What each role may ask: its requests, and the refusal of all others.

A request that is new on the wire is refused to observers, unless it is a question, and to guests.
Which peer has which role: `arbiter.rpc.peer`. Must not know sessions.
"""

import os
import shlex
from collections.abc import Callable, Mapping
from typing import Any, Final, Literal

from vram_arbiter.schemas.errors import NotPermitted, RemoteMayNotHold
from vram_arbiter.schemas.units import format_bytes
from vram_arbiter.schemas.wire import requests as w

type Role = w.Role | Literal["guest"]
"""A guest does not ask for its role: its group makes it one."""
_ALL: Final[frozenset[type[Any]]] = frozenset(w.REQUESTS.values())
_BY_HAND: Final = frozenset(cls for cls in _ALL if issubclass(cls, w.ByHand))
_MAY: Final[Mapping[Role, frozenset[type[Any]]]] = {
    "operator": _ALL,
    "client": _ALL - _BY_HAND,
    "observer": frozenset(cls for cls in _ALL if issubclass(cls, w.Question)),
    "guest": frozenset(
        {w.Hello, w.Ping, w.Bye, w.Status, w.AskWhy, w.Subscribe, w.Prepare, w.UseBegin, w.UseEnd}
    ),
}


def check(role: Role, request: w.AnyRequest) -> None:
    """Raises NotPermitted for a request that the role may not send."""
    if type(request) not in _MAY[role]:
        raise _REFUSALS[role](request)


def _of_client(request: w.AnyRequest) -> NotPermitted:
    return NotPermitted(f"only an operator may {request.TAG[1]}", hint="say hello as operator")


def _of_observer(request: w.AnyRequest) -> NotPermitted:
    return NotPermitted(f"an observer may not {request.TAG[1]}", hint="say hello as a client")


def _of_guest(request: w.AnyRequest) -> NotPermitted:
    host = os.uname().nodename
    if not isinstance(request, w.Acquire):
        return NotPermitted(
            f"a guest may not {request.TAG[1]}",
            hint=f"ask on {host}, as a user outside the guests' group",
        )
    spec = request.spec
    name = f"--name {shlex.quote(spec.consumer)}"
    size = format_bytes(spec.footprint.load_peak_bytes).replace(" ", "")
    return RemoteMayNotHold(
        f"a guest holds no lease: the bytes are on {host}, and so is the process that holds them",
        hint=f"on {host} run `vram-sidecar {name} --rskill FILE`, or `vramctl run {name} --vram "
        f"{size} -- PROGRAM`, and use its lease from here",
        details={"host": host},
    )


_REFUSALS: Final[Mapping[Role, Callable[[w.AnyRequest], NotPermitted]]] = {
    "client": _of_client,
    "observer": _of_observer,
    "guest": _of_guest,
}
