"""Server that imports a program, and forks it for each order of `prepared`; started by that."""

import contextlib
import gc
import json
import os
import select
import socket
import struct
import sys
from collections.abc import Sequence
from importlib import import_module
from typing import Any

from tests.support import fork_server
from tests.support.prepared import DESCRIPTORS_MAX, HELLO, MESSAGE_MAX, PATIENCE_S, PROGRAMS

type Order = dict[str, Any]


class _Server:
    """Forks a program for each order."""

    def __init__(self, listener: socket.socket) -> None:
        self._listener = listener
        self._clients: set[socket.socket] = set()
        self._running: dict[int, tuple[int, socket.socket]] = {}  # pidfd → pid, where status goes

    def serve(self) -> Order | None:
        """Return the order in the child, None when the last client has gone."""
        while True:
            waited: list[socket.socket | int] = [self._listener, *self._clients, *self._running]
            found = select.select(waited, [], [], None if self._clients else PATIENCE_S)[0]
            if not found and not self._clients:
                return None
            for ready in found:
                if isinstance(ready, int):
                    self._bury(ready)
                elif ready is self._listener:
                    self._accept()
                elif (order := self._obey(ready)) is not None:
                    return order
            if not self._clients and not select.select([self._listener], [], [], 0)[0]:
                return None

    def _accept(self) -> None:
        client, _ = self._listener.accept()
        peer = client.getsockopt(socket.SOL_SOCKET, socket.SO_PEERCRED, 12)
        if struct.unpack("3i", peer)[1] != os.getuid():  # anyone may connect: it has no file
            client.close()
            return
        client.send(HELLO)
        self._clients.add(client)

    def _bury(self, pidfd: int) -> None:
        pid, told = self._running.pop(pidfd)
        code = os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])
        with told, contextlib.suppress(OSError):  # the test may have ended
            told.send(str(code).encode())
        os.close(pidfd)

    def _obey(self, client: socket.socket) -> Order | None:
        """Fork the program. Return its order in the child."""
        try:
            text, descriptors, _, _ = socket.recv_fds(client, MESSAGE_MAX, DESCRIPTORS_MAX)
        except ConnectionResetError:
            text, descriptors = b"", []
        if not text:
            client.close()
            self._clients.remove(client)
            return None
        order: Order = json.loads(text)
        status, *given = descriptors
        pid = os.fork()
        if pid == 0:
            os.close(status)
            self._leave()
            _become(order, given)
            return order
        for descriptor in given:
            os.close(descriptor)
        pidfd = os.pidfd_open(pid)
        self._running[pidfd] = (pid, socket.socket(fileno=status))
        with contextlib.suppress(OSError):  # the test may have ended
            socket.send_fds(client, [str(pid).encode()], [pidfd])
        return None

    def _leave(self) -> None:
        """Close the server's descriptors in the child."""
        self._listener.close()
        for client in self._clients:
            client.close()
        for pidfd, (_, told) in self._running.items():
            os.close(pidfd)
            told.close()


def _become(order: Order, given: Sequence[int]) -> None:
    fork_server.place_descriptors(given, order["numbers"])
    if order["session"]:
        os.setsid()
    os.environ.clear()
    os.environ.update(order["environ"])
    os.chdir(order["cwd"])
    if (user := order["user"]) is not None:
        os.setgroups([])
        os.setresgid(user, user, user)
        os.setresuid(user, user, user)


if __name__ == "__main__":
    name, descriptor = sys.argv[1:]
    for imported in (*PROGRAMS[name].imports, PROGRAMS[name].module):
        import_module(imported)
    gc.freeze()  # collections in the children need not copy these pages
    ordered = _Server(socket.socket(fileno=int(descriptor))).serve()
    if ordered is not None:
        program = PROGRAMS[ordered["program"]]
        sys.argv = [ordered["program"], *ordered["arguments"]]
        if program.forks:
            fork_server.lend()
        sys.exit(import_module(program.module).main())
