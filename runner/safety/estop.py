"""The emergency stop's server: a socket and a thread of its own, so that no goal, picture or flood
of requests delays a stop.

The thread latches the stop in the robot (`request_estop`), answers, and posts `obey_estop` to the
control thread to learn what became of the motors. It uses no event loop and no decoder, and waits
for neither. Packets: `schemas.estop`.
"""

from __future__ import annotations

import contextlib
import errno
import logging
import os
import select
import selectors
import socket
import stat
import threading
import time
from collections import Counter
from collections.abc import Callable
from concurrent.futures import Future
from dataclasses import dataclass
from typing import Self

from vram_arbiter.runner.control.realtime import hasten
from vram_arbiter.runner.protocols import InferenceRunner
from vram_arbiter.schemas.errors import AlreadyRunning, ConfigError, EstopRequested, InternalError
from vram_arbiter.schemas.estop import REQUEST_MAX_BYTES, Answer, Reply, path_of, reason_in
from vram_arbiter.schemas.runtime.peercred import credentials

log = logging.getLogger(__name__)

OBEY_S = 1.0  # a control loop that has not obeyed by then hangs
CONNECTIONS_MAX = 32
CONNECTIONS_PER_UID = 16
SILENT_S = 1.0  # a connection that has asked nothing by then is closed
BACKLOG = 16  # connections that the kernel holds for us: a stop waits behind so many at most
ROUND_MAX = 8  # connections accepted before those that have asked are served
# after a round, or as long as the round worked: a flood takes neither the interpreter nor a core
PAUSE_S = 0.0002
CHECK_S = 1.0  # how often the socket's file is looked at
MODE = 0o660
_NO_DESCRIPTOR = (errno.EMFILE, errno.ENFILE)


@dataclass(slots=True)
class _Connection:
    socket: socket.socket
    pid: int
    uid: int
    since_s: float
    obey_by_s: float | None = None  # set once it has asked


class EstopServer:
    """`with EstopServer(endpoint, robot): ...` serves `path_of(endpoint)`; the caller
    holds the goal endpoint's lock.

    Args: `on_stop(reason, pid, uid)` is called once, on the server's thread, after the first
    request is answered, and must not wait; `robot_id` stands in every reply; `obey_s` seconds
    without an answer of the control thread are called a hang; after `silent_s` a connection without
    a request is closed; `realtime` asks the kernel to run the thread before ordinary programs.
    Raises ConfigError where the socket cannot be made, AlreadyRunning where something else listens
    there.
    """

    def __init__(
        self,
        endpoint: str,
        robot: InferenceRunner,
        *,
        on_stop: Callable[[str, int, int], None],
        robot_id: str = "",
        obey_s: float = OBEY_S,
        silent_s: float = SILENT_S,
        realtime: bool = False,
    ) -> None:
        self.path = path_of(endpoint)
        self._robot = robot
        self._on_stop = on_stop
        self._robot_id = robot_id
        self._obey_s = obey_s
        self._silent_s = silent_s
        self._realtime = realtime
        self._stopping = False
        self._connections: dict[int, _Connection] = {}  # by descriptor, oldest first
        self._wake = -1
        self._waking = threading.Lock()
        self._told = False  # `on_stop` was called
        self._obeying: Future[EstopRequested | None] | None = None  # until its outcome is told
        self._spare: int | None = (
            None  # a descriptor for the time when the process has used all others
        )
        self._file: tuple[int, int] | None = None  # device and inode of the bound socket
        self._thread = threading.Thread(target=self._main, name="estop", daemon=True)

    # -- life
    def __enter__(self) -> Self:
        self._listener = self._bind()
        self._keep_spare()
        self._wake = os.eventfd(0, os.EFD_CLOEXEC | os.EFD_NONBLOCK)
        self._selector = selectors.DefaultSelector()
        self._selector.register(self._listener, selectors.EVENT_READ)
        self._selector.register(self._wake, selectors.EVENT_READ)
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stopping = True
        self._wake_up()
        self._thread.join()
        with contextlib.suppress(OSError):
            if self._is_ours():
                os.unlink(self.path)
        for connection in list(self._connections.values()):
            if connection.obey_by_s is not None:
                self._reply(
                    connection, Answer.HUNG, "the runner ended before its control loop obeyed"
                )
            self._close(connection)
        self._selector.close()
        self._listener.close()
        with self._waking:
            os.close(self._wake)
            self._wake = -1
        if self._spare is not None:
            os.close(self._spare)

    def _wake_up(self) -> None:
        """Wake the server's thread. Any thread; safe after the server has ended."""
        with self._waking:
            if self._wake >= 0:
                os.eventfd_write(self._wake, 1)

    def _bind(self) -> socket.socket:
        listener = socket.socket(
            socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC | socket.SOCK_NONBLOCK
        )
        try:
            with contextlib.suppress(FileNotFoundError):
                if stat.S_ISSOCK(os.lstat(self.path).st_mode):
                    os.unlink(
                        self.path
                    )  # of a runner that was killed: the caller holds the endpoint's lock
            os.fchmod(listener.fileno(), MODE)  # the file is never open to more than this
            listener.bind(self.path)
            os.chmod(self.path, MODE)  # the umask may have taken the group's share
            listener.listen(BACKLOG)
            found = os.lstat(self.path)
        except OSError as error:
            listener.close()
            if error.errno == errno.EADDRINUSE:
                raise AlreadyRunning(
                    f"{self.path} exists and is not a socket", hint="remove it"
                ) from error
            raise ConfigError(
                f"cannot serve the emergency stop on {self.path}: {error.strerror or error}",
                hint="use a short path in a folder of your own",
            ) from error
        self._file = (found.st_dev, found.st_ino)
        return listener

    def _is_ours(self) -> bool:
        try:
            found = os.lstat(self.path)
        except OSError:
            return False
        return (found.st_dev, found.st_ino) == self._file

    # -- the thread
    def _main(self) -> None:
        if self._realtime:
            hasten(realtime=True)
        check_s = time.monotonic() + CHECK_S
        while not self._stopping:
            try:
                self._round(check_s)
                if time.monotonic() >= check_s:
                    check_s = time.monotonic() + CHECK_S
                    self._check_file()
            except Exception:  # the stop is served as long as the process lives
                log.exception("the emergency stop's thread goes on after an error")
                time.sleep(PAUSE_S)

    def _round(self, check_s: float) -> None:
        """Wait for work, and do at most one round of it."""
        due = [
            check_s,
            *(c.obey_by_s or c.since_s + self._silent_s for c in self._connections.values()),
        ]
        ready = self._selector.select(max(0.0, min(due) - time.monotonic()))
        began_cpu_s = time.thread_time()  # waiting for the interpreter lock is not work
        for key, _ in ready:
            if key.fileobj is self._listener:
                self._accept()
            elif key.fd == self._wake:
                os.eventfd_read(self._wake)
            elif (connection := self._connections.get(key.fd)) is not None:
                self._read(connection)
        if self._obeying is not None and self._obeying.done():
            obeyed, self._obeying = self._obeying, None
            self._tell_outcome(obeyed)
        now_s = time.monotonic()
        for connection in list(self._connections.values()):
            if connection.obey_by_s is None and now_s >= connection.since_s + self._silent_s:
                self._close(connection)
            elif connection.obey_by_s is not None and now_s >= connection.obey_by_s:
                self._reply(
                    connection,
                    Answer.HUNG,
                    f"the control loop has not obeyed the emergency stop"
                    f" within {self._obey_s:.0f} s",
                )
                self._close(connection)
        self._keep_spare()
        if ready:
            time.sleep(max(PAUSE_S, time.thread_time() - began_cpu_s))

    def _accept(self) -> None:
        """Each is read at once: a client that has sent its request is served before anything can
        evict it.
        """
        for _ in range(ROUND_MAX):
            try:
                accepted, _ = self._listener.accept()
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno in _NO_DESCRIPTOR and not (
                    self._is_asked_for() and self._free_descriptor()
                ):
                    return
                continue  # or it hung up meanwhile
            self._welcome(accepted)

    def _is_asked_for(self) -> bool:
        """Without descriptors accept() fails before it looks whether anything is there."""
        return bool(select.select([self._listener], [], [], 0)[0])

    def _free_descriptor(self) -> bool:
        """The process has used its descriptors up: a silent connection has to go, or the one kept
        for this. False: there is none left.
        """
        silent = next((c for c in self._connections.values() if c.obey_by_s is None), None)
        if silent is not None:
            self._close(silent)
        elif self._spare is not None:
            os.close(self._spare)
            self._spare = None
        else:
            return False
        return True

    def _keep_spare(self) -> None:
        if self._spare is None:
            with contextlib.suppress(OSError):
                self._spare = os.open(os.devnull, os.O_RDONLY | os.O_CLOEXEC)

    def _welcome(self, accepted: socket.socket) -> None:
        accepted.setblocking(False)
        pid, uid, _ = credentials(accepted)
        self._make_room(uid)
        connection = _Connection(accepted, pid, uid, time.monotonic())
        self._connections[accepted.fileno()] = connection
        self._selector.register(accepted, selectors.EVENT_READ)
        self._read(connection)

    def _make_room(self, uid: int) -> None:
        """Where a user, or all, have their share of connections: close the oldest silent one of the
        process with the most of them, so that a process with one connection keeps it. Before that
        it may still say what it has sent.
        """
        candidates = list(self._connections.values())
        of_uid = [c for c in candidates if c.uid == uid]
        if len(of_uid) >= CONNECTIONS_PER_UID:
            candidates = of_uid
        elif len(candidates) < CONNECTIONS_MAX:
            return
        silent = [c for c in candidates if c.obey_by_s is None]
        if not silent:
            self._close(candidates[0])  # it has its first answer
            return
        by_process = Counter(c.pid for c in silent)
        victim = max(silent, key=lambda c: by_process[c.pid])  # the oldest of those with the most
        self._read(victim)
        self._close(victim)

    def _read(self, connection: _Connection) -> None:
        try:
            packet = connection.socket.recv(REQUEST_MAX_BYTES)
        except BlockingIOError:
            return
        except OSError:
            packet = b""
        reason = reason_in(packet)
        if reason is None:
            self._close(connection)
        else:
            self._stop(connection, reason or "on request")

    def _stop(self, connection: _Connection, reason: str) -> None:
        """Latch before anything else."""
        first = self._robot.estop is None
        self._robot.request_estop(reason)
        connection.obey_by_s = time.monotonic() + self._obey_s
        self._selector.unregister(connection.socket)  # one request a connection
        in_force = (
            str(self._robot.estop.details.get("reason", ""))
            if self._robot.estop is not None
            else reason
        )
        self._reply(connection, Answer.LATCHED if first else Answer.ALREADY, in_force)
        if self._obeying is None:
            try:
                self._obeying = self._robot.mailbox.post(self._robot.obey_estop)
            except InternalError as error:
                self._obeying = Future()
                self._obeying.set_exception(error)
            self._obeying.add_done_callback(lambda _: self._wake_up())  # on the control thread
        if not self._told:
            self._told = True
            self._on_stop(reason, connection.pid, connection.uid)

    def _tell_outcome(self, obeyed: Future[EstopRequested | None]) -> None:
        if (failure := obeyed.exception()) is not None:
            answer = Answer.HUNG
            text = f"the control loop did not obey the emergency stop: {failure}"
        elif (error := obeyed.result()) is not None and not error.details.get("told", True):
            answer, text = Answer.NOT_TOLD, error.message
        else:
            answer, text = Answer.OBEYED, error.message if error is not None else ""
        for connection in [c for c in self._connections.values() if c.obey_by_s is not None]:
            self._reply(connection, answer, text)
            self._close(connection)

    def _reply(self, connection: _Connection, answer: Answer, text: str) -> None:
        """Send a reply. A peer that does not read or is gone gets none."""
        reply = Reply(answer, self._robot.estop_ns, self._robot_id, text)
        with contextlib.suppress(OSError):
            connection.socket.send(reply.encode())

    def _close(self, connection: _Connection) -> None:
        if self._connections.pop(connection.socket.fileno(), None) is None:
            return
        with contextlib.suppress(KeyError):
            self._selector.unregister(connection.socket)
        connection.socket.close()

    def _check_file(self) -> None:
        """Recreate a socket file that was deleted or replaced: stops must stay possible."""
        if self._is_ours():
            return
        log.error("%s is gone; it is made again", self.path)
        try:
            listener = self._bind()
        except (ConfigError, AlreadyRunning) as error:
            log.critical("no emergency stop can be heard: %s", error)
            return
        self._selector.unregister(self._listener)
        self._listener.close()
        self._listener = listener
        self._selector.register(listener, selectors.EVENT_READ)
