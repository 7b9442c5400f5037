"""The emergency stop, asked on its own socket: blocking, with nothing imported that is not needed
to stop a robot. Packets: `schemas.estop`.
"""

import contextlib
import os
import socket
import struct
import time
from dataclasses import dataclass

from vram_arbiter.schemas.errors import BadFrame, InternalError, RobotFault, RunnerUnreachable
from vram_arbiter.schemas.estop import REPLY_MAX_BYTES, Answer, Reply, path_of, reply_in, request
from vram_arbiter.schemas.runtime.trust import check_server

ANSWER_S = 3.0  # the runner itself waits a second for its control loop
RETRY_S = 0.001
CUT = "cut the robot's power"


@dataclass(frozen=True, slots=True)
class Stopped:
    """The motors have been told. `message` says what they do now; `first` is False where an earlier
    stop was in force.
    """

    robot: str
    message: str
    reason: str
    first: bool
    stopped_ns: int


def stop(endpoint: str, reason: str = "", *, timeout_s: float = ANSWER_S) -> Stopped:
    """Stop the robot whose runner serves goals at `endpoint`. Returns once the motors have been
    told.

    Raises RunnerUnreachable when no runner latched the stop, InternalError when it is latched and
    its control loop does not obey, RobotFault when the motors could not be told, UntrustedServer
    when another user listens there, ConfigError for an endpoint that is not one.
    """
    path = path_of(endpoint)
    deadline = time.monotonic() + timeout_s
    while True:
        with contextlib.closing(_connected(endpoint, path, timeout_s)) as connection:
            try:
                latched = _latched(connection, reason)
            except (OSError, BadFrame) as error:
                if not isinstance(error, BlockingIOError) and time.monotonic() < deadline:
                    time.sleep(
                        RETRY_S
                    )  # its place was taken before it had asked: others flood the socket
                    continue
                raise _unreachable(endpoint, _words(error)) from error
            try:
                outcome = reply_in(connection.recv(REPLY_MAX_BYTES))
            except (OSError, BadFrame) as error:
                raise InternalError(
                    f"{endpoint} has latched the stop and does not say what became of the motors: "
                    f"{_words(error)}",
                    hint=CUT,
                ) from error
        return _judged(endpoint, latched, outcome)


def _latched(connection: socket.socket, reason: str) -> Reply:
    connection.send(request(reason))
    return reply_in(connection.recv(REPLY_MAX_BYTES))


def _connected(endpoint: str, path: str, timeout_s: float) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET | socket.SOCK_CLOEXEC)
    # of the kernel, not of Python: connect() then queues fairly where many connect, instead of
    # being refused
    limit = struct.pack("ll", int(timeout_s), int(timeout_s % 1 * 1e6))
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
    try:
        connection.connect(path)
        check_server(connection, "runner", endpoint)
    except OSError as error:
        connection.close()
        raise _unreachable(endpoint, _words(error)) from error
    except BaseException:
        connection.close()
        raise
    return connection


def _unreachable(endpoint: str, why: str) -> RunnerUnreachable:
    return RunnerUnreachable(
        f"no runner stops at {endpoint}: {why}",
        hint="start `vram-runner`, or see its log",
        details={"endpoint": endpoint, "uid": os.geteuid()},
    )


def _words(error: Exception) -> str:
    if isinstance(error, BadFrame):
        return "it hung up, or answered something else"
    if isinstance(error, FileNotFoundError):
        return "its emergency-stop socket does not exist"
    if isinstance(error, ConnectionRefusedError):
        return "its runner was killed and left the socket behind"
    if isinstance(error, PermissionError):
        return f"uid {os.geteuid()} may not use its socket"
    if isinstance(error, BlockingIOError):
        return "no answer in time"
    return str(error)


def _judged(endpoint: str, latched: Reply, outcome: Reply) -> Stopped:
    if outcome.answer is Answer.NOT_TOLD:
        raise RobotFault(
            outcome.text, hint=f"{CUT}; the runner keeps trying", details={"endpoint": endpoint}
        )
    if outcome.answer is not Answer.OBEYED:
        raise InternalError(
            outcome.text, hint=f"{CUT}; the loop hangs, and moves nothing if it comes back"
        )
    return Stopped(
        robot=outcome.robot,
        message=outcome.text,
        reason=latched.text,
        first=latched.answer is Answer.LATCHED,
        stopped_ns=latched.stopped_ns,
    )
