"""The status page: how soon an open page hears of a change beside a thousand leases, what it
weighs, and what it costs the daemon at rest, with a page open and under attack."""

import http.client
import json
import socket
import statistics
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from tests.bench.bench_rest import QUIET_AFTER_S, busy_percent
from tests.bench.harness import SHIPPED, WIDE, Peer, Suite, arbiter, elapsed_us, in_turns, pause
from tests.support.observer import ObserverProcess
from tests.support.process import ArbiterProcess
from tests.support.processes import rss_bytes

LEASES = 1000
PER_CONNECTION = 64
STATIC = Path(__file__).parents[2] / "clients/observer/page/static"


def run(suite: Suite) -> None:
    weight = sum(file.stat().st_size for file in STATIC.iterdir())
    suite.figure("all files of the status page", weight / 1000, "kB", at_most=100.0)
    rest(suite)
    updates(suite)
    attacks(suite)


def rest(suite: Suite) -> None:
    """The daemon at rest: alone, with an observer and nobody looking, with a page open."""
    with arbiter(SHIPPED) as daemon:
        _at_rest(suite, daemon, "without an observer")
        with ObserverProcess(daemon) as observer:
            _at_rest(suite, daemon, "with an observer")
            memory = rss_bytes(observer.pid) / 2**20
            suite.figure("memory of the observer at rest", memory, "MB")
            with open_page(observer.port):
                share = busy_percent(daemon.pid, suite.size(10, 2))
                own = busy_percent(observer.pid, suite.size(10, 2))
        suite.figure("CPU of the daemon at rest, one page open", share, "% of a core")
        suite.figure("CPU of the observer at rest, one page open", own, "% of a core")


def _at_rest(suite: Suite, daemon: ArbiterProcess, name: str) -> None:
    if not suite.quick:
        pause(QUIET_AFTER_S)
    share = busy_percent(daemon.pid, suite.size(10, 2))
    memory = rss_bytes(daemon.pid) / 2**20
    suite.figure(f"memory of the daemon at rest, {name}", memory, "MB", at_most=55.0)
    suite.figure(f"CPU of the daemon at rest, {name}", share, "% of a core", at_most=0.3)


def updates(suite: Suite) -> None:
    """A thousand leases held; another one comes and goes, and a page hears of it."""
    with ExitStack() as stack:
        daemon = stack.enter_context(arbiter(WIDE))
        for start in range(0, LEASES, PER_CONNECTION):
            holder = Peer(daemon.endpoint, f"holder{start}").greeted()
            stack.callback(holder.close)
            for _ in range(min(PER_CONNECTION, LEASES - start)):
                holder.ready(holder.lease())
        peer = Peer(daemon.endpoint, "seen").greeted()
        stack.callback(peer.close)
        observer = stack.enter_context(ObserverProcess(daemon))
        page = stack.enter_context(open_page(observer.port))
        page.heard("snapshot")
        times: list[float] = []
        for number in range(suite.size(100, 20)):
            pause(0.13 + 0.017 * (number % 13))  # at every phase of the page's own period
            began = time.perf_counter()
            lease = peer.lease()
            page.heard(str(lease["lease_id"]))
            times.append((time.perf_counter() - began) * 1e6)
            peer.release(lease)
        name = f"a lease comes and an open page has it, beside {LEASES} leases"
        suite.limit(name, times, p99_max_us=200_000)
        share = busy_percent(daemon.pid, suite.size(10, 2))
        suite.figure(f"CPU with {LEASES} leases and one page open", share, "% of a core")
        cycles = {"open": lambda: elapsed_us(lambda: peer.release(peer.lease()))}
        found = in_turns(suite.size(300, 50), cycles)["open"]
        suite.time("acquire + release meanwhile", found)


def attacks(suite: Suite) -> None:
    """Round trips of a calm client while peers send to the page what costs most."""
    floods = {
        "heads of 8 KiB": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * 1300 + b"\r\n",
        "unfinished heads": b"GET / HTTP/1.1\r\nHost: localhost\r\n" + b"a: b\r\n" * 1200,
        "a storm of connections": b"",
        "snapshots": b"GET /events HTTP/1.1\r\nHost: localhost\r\n\r\n",
        "pages of the history": b"GET /history HTTP/1.1\r\nHost: localhost\r\n\r\n" * 20,
    }
    with arbiter(WIDE) as daemon, ObserverProcess(daemon) as observer:
        port, peer = observer.port, Peer(daemon.endpoint, "calm").greeted()

        def ping() -> float:
            return elapsed_us(lambda: peer.ask("ping"))

        def spaced_ping() -> float:
            pause(0.002)
            return ping()

        calm = [ping() for _ in range(suite.size(500, 100))]
        suite.time("ping of a calm client, nobody attacks the page", calm)
        for name, sent in floods.items():
            with flooding(port, sent):
                found = [spaced_ping() for _ in range(suite.size(500, 100))]
            longest = f"longest {max(found) / 1000:.1f} ms, median of the calm "
            longest += f"{statistics.median(calm):.0f} µs"
            suite.limit(f"ping while the page gets {name}", found, p99_max_us=20e3, note=longest)
        peer.close()


class OpenPage:
    """Reads the events of a page in a thread, and waits for texts in them."""

    def __init__(self, port: int) -> None:
        self._connection = http.client.HTTPConnection("127.0.0.1", port, timeout=60)
        self._connection.request("GET", "/events")
        self._reply = self._connection.getresponse()
        self._ids: set[str] = set()
        self._changed = threading.Condition()
        self._thread = threading.Thread(target=self._read, daemon=True)
        self._thread.start()

    def _read(self) -> None:
        name = ""
        try:
            while line := self._reply.readline():
                key, _, value = line.decode().rstrip("\n").partition(": ")
                if key == "event":
                    name = value
                elif key == "data" and name in ("snapshot", "page"):
                    leases = json.loads(value)["leases"]
                    with self._changed:
                        self._ids |= {name, *(one["lease_id"] for one in leases)}
                        self._changed.notify()
        except (OSError, ValueError, AttributeError):
            return  # closed

    def heard(self, text: str) -> None:
        with self._changed:
            if not self._changed.wait_for(lambda: text in self._ids, 30):
                raise TimeoutError(f"the page never heard of {text}")

    def close(self) -> None:
        if self._connection.sock is not None:
            self._connection.sock.shutdown(socket.SHUT_RDWR)
        self._connection.close()
        self._thread.join(5)


@contextmanager
def open_page(port: int) -> Iterator[OpenPage]:
    page = OpenPage(port)
    try:
        yield page
    finally:
        page.close()


@contextmanager
def flooding(port: int, sent: bytes) -> Iterator[None]:
    """Connect, send, and connect again, from one thread."""
    end = threading.Event()

    def flood() -> None:
        made: list[socket.socket] = []
        while not end.is_set():
            try:
                one = socket.create_connection(("127.0.0.1", port), timeout=1)
                made.append(one)
                one.sendall(sent)
            except OSError:
                pass
            if len(made) > 24:
                made.pop(0).close()
        for one in made:
            one.close()

    thread = threading.Thread(target=flood)
    thread.start()
    try:
        yield
    finally:
        end.set()
        thread.join()
