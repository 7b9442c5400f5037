"""ssh's ProxyCommand as ssh runs it, against a real listener."""

import socket
import subprocess
import sys

import pytest

from tests.support.waiting import PATIENCE_S
from vram_arbiter.clients.remote import dial

COMMAND = (sys.executable, "-IS", dial.__file__)


def test_it_relays_both_ways_and_passes_an_end_on() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        ssh = subprocess.Popen(
            [*COMMAND, "127.0.0.1", port], stdin=subprocess.PIPE, stdout=subprocess.PIPE
        )
        assert ssh.stdin is not None
        assert ssh.stdout is not None
        peer, _ = listener.accept()
        with peer:
            peer.settimeout(PATIENCE_S)
            peer.sendall(b"greeting")
            assert ssh.stdout.read(8) == b"greeting"
            ssh.stdin.write(b"x" * 450_000)
            ssh.stdin.close()
            heard = bytearray()
            while chunk := peer.recv(1 << 16):
                heard += chunk
            assert len(heard) == 450_000
            peer.sendall(b"y" * 450_000)  # still heard behind the end of the other direction
            peer.shutdown(socket.SHUT_WR)
            assert len(ssh.stdout.read()) == 450_000
        ssh.stdout.close()
        assert ssh.wait(PATIENCE_S) == 0


def test_it_frees_the_output_of_an_ssh_that_has_ended() -> None:
    """Its starter reads that output to its end, and would wait as long as the server is silent."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        with subprocess.Popen(
            [*COMMAND, "127.0.0.1", port], stdin=subprocess.PIPE, stderr=subprocess.PIPE
        ) as ssh:
            assert ssh.stdin is not None
            assert ssh.stderr is not None
            peer, _ = listener.accept()
            with peer:
                ssh.stdin.close()
                assert ssh.stderr.read() == b""
                assert ssh.poll() is None, "it waits for the server's last words"


@pytest.mark.parametrize("end", ["server", "ssh"])
def test_it_ends_with_either_end(end: str) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
        ssh = subprocess.Popen(
            [*COMMAND, "127.0.0.1", port],
            stdin=subprocess.PIPE,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
        )
        peer, _ = listener.accept()
        with peer:
            if end == "server":
                peer.close()
            else:
                ssh.stdout.close()
                peer.sendall(b"nobody reads it")
            assert ssh.wait(PATIENCE_S) == 0
        assert ssh.stderr.read() == b""
        for stream in (ssh.stdin, ssh.stdout, ssh.stderr):
            if stream is not None:
                stream.close()


def test_an_error_is_one_line() -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        port = str(listener.getsockname()[1])
    ended = subprocess.run(
        [*COMMAND, "127.0.0.1", port], capture_output=True, text=True, check=False
    )
    assert ended.returncode == 1
    assert ended.stderr == f"dial 127.0.0.1 port {port}: Connection refused\n"
