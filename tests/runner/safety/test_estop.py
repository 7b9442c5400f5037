"""The emergency stop's socket: answered while the event loop stands still, under a flood of
connections, and without descriptors.
"""

import asyncio
import contextlib
import os
import pwd
import resource
import socket
import stat
import struct
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, cast

import pytest
from hypothesis import given
from hypothesis import strategies as st

from vram_arbiter.clients.estop import stop
from vram_arbiter.runner.__main__ import main
from vram_arbiter.runner.control.mailbox import Mailbox
from vram_arbiter.runner.safety.estop import CONNECTIONS_PER_UID, SILENT_S, EstopServer
from vram_arbiter.schemas.errors import (
    AlreadyRunning,
    BadFrame,
    ConfigError,
    EstopRequested,
    InternalError,
    RunnerUnreachable,
)
from vram_arbiter.schemas.estop import (
    PREFIX,
    Answer,
    Reply,
    one_line,
    path_of,
    reason_in,
    reply_in,
    request,
)

WAIT_S = 60.0


class Robot:
    """A control thread that does nothing but obey."""

    def __init__(self) -> None:
        self.estop: EstopRequested | None = None
        self.estop_ns = 0
        self.asked: list[str] = []
        self.mailbox = Mailbox()
        self.hangs = threading.Event()
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._main)
        self._thread.start()

    def request_estop(self, reason: str) -> None:
        self.asked.append(reason)
        if self.estop is None:
            self.estop_ns = time.monotonic_ns()
            self.estop = EstopRequested(f"emergency stop: {reason}", details={"reason": reason})

    def obey_estop(self) -> EstopRequested | None:
        return self.estop

    def _main(self) -> None:
        while not self._ended.wait(0.001):
            if not self.hangs.is_set():
                self.mailbox.run_pending()

    def close(self) -> None:
        self._ended.set()
        self._thread.join()


@pytest.fixture
def robot() -> Iterator[Robot]:
    made = Robot()
    yield made
    made.close()


@pytest.fixture
def serve_estop(robot: Robot, endpoint: str) -> Callable[..., EstopServer]:
    def make(obey_s: float = WAIT_S, silent_s: float = SILENT_S) -> EstopServer:
        runner: Any = robot  # as much of a runner as a stop needs
        return EstopServer(
            endpoint,
            runner,
            on_stop=lambda *_: None,
            robot_id="bench",
            obey_s=obey_s,
            silent_s=silent_s,
        )

    return make


def connect_to(endpoint: str) -> socket.socket:
    connection = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
    # of the kernel: with Python's a full backlog is an error at once
    limit = struct.pack("ll", int(WAIT_S), 0)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_SNDTIMEO, limit)
    connection.setsockopt(socket.SOL_SOCKET, socket.SO_RCVTIMEO, limit)
    connection.connect(path_of(endpoint))
    return connection


def test_a_stop_is_answered_while_the_event_loop_stands_still(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    """Regression: the stop came in on the goal socket; three million empty frames there delayed it
    by 20.9 s.
    """

    async def scenario() -> str:
        with serve_estop():
            # nothing else runs on this loop until it returns
            return stop(endpoint, "smoke", timeout_s=WAIT_S).message

    assert asyncio.run(scenario()) == "emergency stop: smoke"


def test_the_first_reason_and_its_time_stay(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    with serve_estop():
        before_ns = time.monotonic_ns()
        first = stop(endpoint, "a hand in the way", timeout_s=WAIT_S)
        again = stop(endpoint, "once more", timeout_s=WAIT_S)
    assert (first.first, first.reason, first.robot) == (True, "a hand in the way", "bench")
    assert (again.first, again.reason) == (False, "a hand in the way")
    assert before_ns < first.stopped_ns == again.stopped_ns < time.monotonic_ns()
    assert robot.asked == ["a hand in the way", "once more"]


def test_a_loop_that_hangs_is_said_after_the_stop_is_latched(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    robot.hangs.set()
    with serve_estop(obey_s=0.05):
        with pytest.raises(InternalError, match="has not obeyed"):
            stop(endpoint, "smoke", timeout_s=WAIT_S)
        assert robot.estop is not None
        robot.hangs.clear()
        assert not stop(endpoint, "again", timeout_s=WAIT_S).first


def test_an_ended_control_thread_is_said(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    robot.mailbox.close()
    with serve_estop(), pytest.raises(InternalError, match="control thread"):
        stop(endpoint, "smoke", timeout_s=WAIT_S)
    assert robot.estop is not None


def test_silent_connections_of_the_same_user_keep_no_stop_out(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    """A peer that may connect could hold all places; the oldest silent connection is closed for a
    new one.
    """
    with serve_estop():
        silent = [connect_to(endpoint) for _ in range(10 * CONNECTIONS_PER_UID)]
        assert stop(endpoint, "smoke", timeout_s=WAIT_S).first
        assert silent[0].recv(1) == b""  # hung up on
        for one in silent:
            one.close()


def test_a_process_with_one_connection_keeps_it_beside_one_with_many(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    """A client that was held up between its connect and its request lost its place to a flood of
    the same user.
    """
    crowd = (
        "import socket, sys; peers = []\n"
        "for _ in range(int(sys.argv[2])):\n"
        "    peers.append(socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET));"
        " peers[-1].connect(sys.argv[1])\n"
        "print(len(peers), flush=True); sys.stdin.read()"
    )
    argv = [sys.executable, "-c", crowd, path_of(endpoint), str(4 * CONNECTIONS_PER_UID)]
    with (
        serve_estop(silent_s=WAIT_S),
        connect_to(endpoint) as honest,
        subprocess.Popen(argv, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as flood,
    ):
        assert flood.stdout.readline()
        connect_to(endpoint).close()  # accepted behind all of them
        honest.send(request("smoke"))
        assert reply_in(honest.recv(4096)).answer is Answer.LATCHED
        flood.communicate()


def test_a_flood_of_connections_from_other_threads_keeps_no_stop_out(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    ended, under_way = threading.Event(), threading.Barrier(5)

    def flood() -> None:
        opened: list[socket.socket] = []
        try:
            for count in range(20_000):
                if ended.is_set():
                    return
                opened.append(connect_to(endpoint))
                if count == 10:
                    under_way.wait(WAIT_S)
                if len(opened) > 50:
                    opened.pop(0).close()
        finally:
            for one in opened:
                one.close()

    with serve_estop():
        floods = [threading.Thread(target=flood) for _ in range(4)]
        for one in floods:
            one.start()
        under_way.wait(WAIT_S)
        assert stop(endpoint, "smoke", timeout_s=WAIT_S).first
        ended.set()
        for one in floods:
            one.join()


def test_a_stop_is_read_by_a_process_that_has_no_descriptor_left(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    """Bare connects to the goal socket could use all descriptors up; the server keeps one for a
    stop.
    """
    soft, hard = resource.getrlimit(resource.RLIMIT_NOFILE)
    with serve_estop(), socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as client:
        client.settimeout(WAIT_S)
        taken: list[int] = []
        resource.setrlimit(
            resource.RLIMIT_NOFILE, (max(map(int, os.listdir("/proc/self/fd"))) + 8, hard)
        )
        try:
            with contextlib.suppress(OSError):
                while True:
                    taken.append(os.dup(0))
            client.connect(path_of(endpoint))
            client.send(request("smoke"))
            replies = [reply_in(client.recv(4096)).answer for _ in range(2)]
        finally:
            resource.setrlimit(resource.RLIMIT_NOFILE, (soft, hard))
            for one in taken:
                os.close(one)
    assert replies == [Answer.LATCHED, Answer.OBEYED]


@pytest.mark.parametrize("packet", [b"stop", b"\x00" * 4096, b"VRAM-ESTO"])
def test_what_is_no_request_stops_nothing_and_is_hung_up_on(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str, packet: bytes
) -> None:
    with serve_estop():
        with connect_to(endpoint) as client:
            client.send(packet)
            assert client.recv(4096) == b""
        assert robot.estop is None
        # any version stops, and a reason that is too long is cut
        with connect_to(endpoint) as client:
            client.send(b"VRAM-ESTOP/7 " + b"x" * 100_000)
            assert reply_in(client.recv(4096)).answer is Answer.LATCHED


def test_a_deleted_socket_file_is_made_again(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str
) -> None:
    path = Path(path_of(endpoint))
    with serve_estop():
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
        path.unlink()
        deadline = time.monotonic() + WAIT_S
        while True:
            try:
                assert stop(endpoint, "smoke", timeout_s=WAIT_S).first
                break
            except RunnerUnreachable:
                assert time.monotonic() < deadline
                time.sleep(0.02)
        assert stat.S_IMODE(path.stat().st_mode) == 0o660
    assert not path.exists()


def test_the_socket_of_a_killed_runner_is_taken_over_and_nothing_else(
    serve_estop: Callable[..., EstopServer], robot: Robot, endpoint: str, tmp_path: Path
) -> None:
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as left_over:
        left_over.bind(path_of(endpoint))
    with pytest.raises(RunnerUnreachable, match="was killed"):
        stop(endpoint, "smoke", timeout_s=WAIT_S)
    with serve_estop():
        assert stop(endpoint, "smoke", timeout_s=WAIT_S).first
    Path(path_of(endpoint)).write_text("a file")
    with pytest.raises(AlreadyRunning, match="not a socket"), serve_estop():
        pass
    with pytest.raises(ConfigError, match="the socket path has"):
        # fits the goal socket, and leaves no room for its emergency stop's
        path_of(f"ipc:///{'x' * 103}")
    with pytest.raises(ConfigError, match=r"no-such-folder/s\.estop: No such file"):
        EstopServer(
            f"ipc://{tmp_path}/no-such-folder/s", cast(Any, robot), on_stop=lambda *_: None
        ).__enter__()
    with pytest.raises(ConfigError, match="tcp:// is refused"):
        path_of("tcp://127.0.0.1:7")


def test_the_words_of_a_request() -> None:
    assert reason_in(request("a hand\nin the\x1b[2J way\udcff")) == "a hand in the [2J way\\udcff"
    assert reason_in(request("")) == ""
    assert reason_in(request("ä" * 9000)) == "ä" * 500
    assert reason_in(b"VRAM-ESTOP/1 \xff\xfe") == "\ufffd\ufffd"


FALSE_RUNNER = """
import os, socket, sys
folder, uid = sys.argv[1], int(sys.argv[2])
os.chdir(folder)
os.setgid(uid)
os.setuid(uid)
listener = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
listener.bind("runner.sock.estop")
listener.listen()
print("listening", flush=True)
peer, _ = listener.accept()
heard = peer.recv(4096)
print(heard, flush=True)
if heard:
    peer.send(b"VRAM-ESTOP/1\\tlatched\\t1\\tbench\\tsmoke")
    peer.send(b"VRAM-ESTOP/1\\tobeyed\\t1\\tbench\\tthe motors hold")
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="only root can start a server of another user")
def test_a_false_runner_is_not_believed_that_the_motors_hold(
    capsys: pytest.CaptureFixture[str],
) -> None:
    nobody = pwd.getpwnam("nobody").pw_uid
    with tempfile.TemporaryDirectory(prefix="va") as folder:
        os.chown(folder, nobody, -1)
        argv = [sys.executable, "-c", FALSE_RUNNER, folder, str(nobody)]
        with subprocess.Popen(argv, stdout=subprocess.PIPE) as false:
            assert false.stdout.readline() == b"listening\n"
            code = main(["estop", "--endpoint", f"ipc://{folder}/runner.sock"])
            assert false.stdout.readline() == b"b''\n"  # nothing was said to it
    said = capsys.readouterr()
    assert (code, said.out) == (1, "")
    assert f"is served by uid {nobody} (nobody)" in said.err
    assert "cut its power" in said.err


@given(st.binary(max_size=600), st.sampled_from([b"", PREFIX, PREFIX + b"1\tlatched\t"]))
def test_no_packet_is_anything_but_a_request_a_reply_or_refused(
    packet: bytes, prefix: bytes
) -> None:
    reason = reason_in(prefix + packet)
    assert (reason is not None) == (prefix + packet).startswith(PREFIX)
    assert reason is None or (reason.isprintable() and len(reason) <= 500)
    with contextlib.suppress(BadFrame):
        reply_in(prefix + packet)


@given(st.sampled_from(Answer), st.integers(0, 1 << 63), st.text(), st.text())
def test_a_reply_is_read_as_it_was_written(
    answer: Answer, stopped_ns: int, robot: str, text: str
) -> None:
    read = reply_in(Reply(answer, stopped_ns, robot, text).encode())
    assert (read.answer, read.stopped_ns) == (answer, stopped_ns)
    assert (read.robot, read.text) == (one_line(robot), one_line(text))
