"""Multiprocessing's fork server from a process that has imported its modules already.

A sidecar starts a server of imports (`sidecars.weights_keeper`), which takes 0.4 s of a core for a
model without libraries and 8 s for one with lerobot. `lend` forks a process that becomes that
server when it is asked for, with the environment of that moment. What the server would import is
there; everything else (its socket, its children, its end with the sidecar) is multiprocessing's
own. A second server of the same program is started as usual.
"""

import fcntl
import json
import os
import socket
import sys
import traceback
from collections.abc import Sequence
from multiprocessing import util
from typing import NoReturn

MESSAGE_MAX = 1 << 17
DESCRIPTORS_MAX = 8
_ABOVE = 512
"""Numbers of descriptors that none of the passed ones has."""


def importing() -> dict[str, str]:
    """Return the variables with which a sidecar imports a model's libraries."""
    from vram_arbiter.sidecars.model_main import THREADS_VARIABLE
    from vram_arbiter.sidecars.weights_keeper import ENVIRONMENT

    return {**ENVIRONMENT, THREADS_VARIABLE: "1"}


def lend() -> None:
    """Fork the process that will be this program's fork server. Call it before any thread runs."""
    orders, ordered = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    pid = os.fork()
    if pid == 0:
        orders.close()
        _run_server(ordered)
    ordered.close()
    start = util.spawnv_passfds

    def spawn(path: bytes, arguments: Sequence[str], passed: Sequence[int]) -> int:
        if not arguments[-1].startswith("from multiprocessing.forkserver import main"):
            return start(path, arguments, passed)
        util.spawnv_passfds = start
        order = {"code": arguments[-1], "passed": passed, "environ": dict(os.environ)}
        with orders:
            socket.send_fds(orders, [json.dumps(order).encode()], passed)
        return pid

    util.spawnv_passfds = spawn  # type: ignore[assignment]  # the stub takes numbers as arguments


def place_descriptors(descriptors: Sequence[int], numbers: Sequence[int]) -> None:
    """Move descriptors to these numbers."""
    aside = [fcntl.fcntl(one, fcntl.F_DUPFD_CLOEXEC, _ABOVE) for one in descriptors]
    for one in descriptors:
        os.close(one)
    for number, one in zip(numbers, aside, strict=True):
        os.dup2(one, number)
        os.close(one)


def _run_server(ordered: socket.socket) -> NoReturn:
    """Run the server; end with the program where it starts none."""
    code = 1
    try:
        text, descriptors, _, _ = socket.recv_fds(ordered, MESSAGE_MAX, DESCRIPTORS_MAX)
        ordered.close()
        if text:
            order = json.loads(text)
            place_descriptors(descriptors, order["passed"])
            os.environ.clear()
            os.environ.update(order["environ"])
            exec(order["code"], {})
        code = 0
    except SystemExit as ended:
        code = ended.code if isinstance(ended.code, int) else 1
    except BaseException:  # noqa: BLE001 - outermost: it must never run on as a second program
        traceback.print_exc()
    finally:
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
