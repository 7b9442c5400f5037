"""What a robot's tunnel costs a request: a sidecar's server on a Unix socket, and the same one
through sshd on loopback, by ssh as it comes and by the product's dial.

Run alone it prints a table; `make bench-fleet` calls `tunnel_rows`. Under load all three
rise together: compare them.
"""

import os
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgpack
import zmq

from tests.bench.harness import Suite, elapsed_us, in_turns, summed
from tests.support.guests import USER
from tests.support.prepared import start
from tests.support.sshd import Sshd
from tests.support.waiting import PATIENCE_S, until
from vram_arbiter.clients.remote.ssh import ARBITER, FORWARDED, Tunnel

PICTURES_BYTES = 450_000
"""Two cameras of a policy's observation."""
SIZES = {"small": 0, "450 kB": PICTURES_BYTES}
AT_MOST = {"small": None, "450 kB": 5.0}
ROUNDS, ROUNDS_QUICK = 300, 50


def tunnel_rows(suite: Suite) -> None:
    """Add the rows: round trips over each way, against the Unix socket."""
    with ExitStack() as stack:
        folder = Path(stack.enter_context(tempfile.TemporaryDirectory(prefix="b")))
        folder.chmod(0o711)
        socket = stack.enter_context(served(folder / f"{ARBITER}.sock"))
        sshd = stack.enter_context(Sshd(folder / "sshd", [USER]))
        ways = {"unix": socket}
        for name in ("stock ssh", "dial"):
            ways[name] = stack.enter_context(forwarded(sshd, socket, folder, name))
        asks = {name: stack.enter_context(asking(path)) for name, path in ways.items()}
        for size, pad_bytes in SIZES.items():
            pad = bytes(pad_bytes)
            calls = {name: lambda ask=ask, pad=pad: elapsed_us(lambda: ask(pad))
                     for name, ask in asks.items()}  # fmt: skip
            found = in_turns(suite.size(ROUNDS, ROUNDS_QUICK), calls)
            floor = found.pop("unix")
            suite.time(f"request of {size}, unix socket", floor)
            for name, samples in found.items():
                at_most = AT_MOST[size] if name == "dial" else None
                suite.compare(f"request of {size}, {name}", samples, floor, "unix socket", at_most)


@contextmanager
def served(path: Path) -> Iterator[Path]:
    """A server of sidecars, in a process of its own, that any user may ask."""
    server = start("op-server", [f"ipc://{path}"], os.environ)
    try:
        until(path.is_socket)
        path.chmod(0o666)
        yield path
    finally:
        server.kill()
        server.wait()


@contextmanager
def forwarded(sshd: Sshd, socket: Path, folder: Path, way: str) -> Iterator[Path]:
    """The server's socket at the robot's end of a tunnel."""
    here = folder / way.replace(" ", "-")
    here.mkdir()
    known_hosts = here / "known_hosts"
    known_hosts.write_text(f"{sshd.host_key_line}\n")
    host = f"{USER}@127.0.0.1:{sshd.port}"
    tunnel = Tunnel(
        host, here, known_hosts, server_runtime=str(socket.parent), identity=sshd.key(USER)
    )
    command = tunnel.command()
    if way != "dial":
        (dial,) = (at for at, word in enumerate(command) if word.startswith("ProxyCommand="))
        del command[dial - 1 : dial + 1]
    ssh = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert ssh.stderr is not None
        said = ssh.stderr.readline()
        assert said.strip() == FORWARDED, said + ssh.communicate()[1]
        yield tunnel.socket(ARBITER)
    finally:
        ssh.terminate()
        ssh.communicate(timeout=PATIENCE_S)


@contextmanager
def asking(path: Path) -> Iterator[Callable[[bytes], None]]:
    """A call that sends a `ping` with so many bytes beside it, and waits for the answer."""
    with zmq.Context() as context, context.socket(zmq.DEALER) as client:
        client.setsockopt(zmq.LINGER, 0)
        client.setsockopt(zmq.RCVTIMEO, int(1000 * PATIENCE_S))
        client.connect(f"ipc://{path}")

        def ask(pad: bytes) -> None:
            client.send(msgpack.packb({"id": 1, "op": "ping", "pad": pad}))
            assert msgpack.unpackb(client.recv())["ok"]

        yield ask


def main() -> int:
    suite = Suite(quick="--quick" in sys.argv)
    tunnel_rows(suite)
    print(f"{suite.table()}\n{summed(row.ok for row in suite.rows)}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
