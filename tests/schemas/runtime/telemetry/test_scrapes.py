"""Prometheus endpoint against hostile readers. Real sockets on loopback.

Regression: eight silent connections kept Prometheus out for ever.
"""

import http.client
import os
import socket
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from vram_arbiter.schemas.runtime.telemetry import scrapes
from vram_arbiter.schemas.runtime.telemetry.scrapes import (
    CONNECTIONS_MAX,
    CONNECTIONS_PER_USER,
    REQUEST_MAX_BYTES,
    KernelTable,
    Owners,
    ScrapeServer,
)

PATIENCE_S = 60.0
SCRAPER, ATTACKER = 1, 2


@pytest.fixture
def scrape_server() -> Iterator[Callable[..., ScrapeServer]]:
    made: list[ScrapeServer] = []

    def make(
        owners: Callable[[], Owners] = KernelTable,
        scrape_s: float = PATIENCE_S,
        host: str = "127.0.0.1",
    ) -> ScrapeServer:
        made.append(
            ScrapeServer(host, 0, lambda accept: (b"up 1\n", "text/plain"), owners, scrape_s)
        )
        made[-1].start()
        return made[-1]

    yield make
    for server in made:
        server.close()


class Users:
    """Which user a port of this test stands for; a table of its own where `KernelTable` asks the
    kernel."""

    def __init__(self) -> None:
        self.of: dict[int, int] = {}

    def __call__(self, peer: tuple[str, int]) -> int | None:
        return self.of.get(peer[1])

    def connect(self, user: int, port: int) -> socket.socket:
        """A connection that is the user's before the server can see it."""
        made = socket.socket()
        made.settimeout(PATIENCE_S)
        made.bind(("127.0.0.1", 0))
        self.of[made.getsockname()[1]] = user
        made.connect(("127.0.0.1", port))
        return made

    def scrape(self, port: int) -> bytes:
        with self.connect(SCRAPER, port) as reader:
            reader.sendall(b"GET /metrics HTTP/1.1\r\nHost: robot\r\n\r\n")
            return b"".join(iter(lambda: reader.recv(4096), b""))


def test_a_page_is_answered_and_nothing_else_is(scrape_server: Callable[..., ScrapeServer]) -> None:
    port = scrape_server().port
    seen = []
    for method, target in (
        ("GET", "/metrics"),
        ("HEAD", "/metrics"),
        ("GET", "/etc"),
        ("POST", "/metrics"),
    ):
        connection = http.client.HTTPConnection("127.0.0.1", port, timeout=PATIENCE_S)
        connection.request(method, target)
        response = connection.getresponse()
        seen.append((response.status, response.read()))
        connection.close()
    assert seen == [(200, b"up 1\n"), (200, b""), (404, b"see /metrics\n"), (405, b"")]


def test_one_user_with_many_silent_connections_does_not_keep_the_scraper_out(
    scrape_server: Callable[..., ScrapeServer],
) -> None:
    """Eight silent connections of any user shut the scraper out for 5 s, and for ever if they came
    again."""
    users = Users()
    port = scrape_server(lambda: users).port
    silent = [users.connect(ATTACKER, port) for _ in range(CONNECTIONS_PER_USER)]
    assert users.scrape(port).endswith(b"up 1\n")
    silent.append(users.connect(ATTACKER, port))
    assert silent[0].recv(1) == b"", "beyond its share the user's oldest connection is closed"
    for user in range(10, 10 + CONNECTIONS_MAX):
        silent.append(users.connect(user, port))
    assert users.scrape(port).endswith(b"up 1\n"), "more users than there are places do not either"
    for one in silent:
        one.close()


def test_a_reader_that_sends_a_byte_at_a_time_is_given_up(
    scrape_server: Callable[..., ScrapeServer],
) -> None:
    """Every byte began the 5 s anew: eight connections with a byte every 4 s held all places for
    ever."""
    port = scrape_server(scrape_s=0.3).port
    with socket.create_connection(("127.0.0.1", port), PATIENCE_S) as slow:
        deadline = time.monotonic() + PATIENCE_S
        with pytest.raises(OSError):  # noqa: PT012 - it ends at any of these calls
            while time.monotonic() < deadline:
                slow.sendall(b"G")
                slow.settimeout(0.02)
                try:
                    if not slow.recv(1):
                        raise ConnectionResetError
                except TimeoutError:
                    pass


def test_a_reader_that_does_not_read_is_given_up() -> None:
    page = b"x" * (64 << 20)  # more than the kernel takes for a connection
    server = ScrapeServer("127.0.0.1", 0, lambda accept: (page, "text/plain"), scrape_s=0.3)
    server.start()
    try:
        with socket.create_connection(("127.0.0.1", server.port), PATIENCE_S) as deaf:
            deaf.sendall(b"GET /metrics HTTP/1.1\r\n\r\n")
            deadline = time.monotonic() + PATIENCE_S
            while server._open or not server._pages:
                assert time.monotonic() < deadline, "its connection is kept"
                time.sleep(0.01)
    finally:
        server.close()


def test_a_request_without_an_end_is_hung_up_on(scrape_server: Callable[..., ScrapeServer]) -> None:
    port = scrape_server().port
    with (  # noqa: PT012
        socket.create_connection(("127.0.0.1", port), PATIENCE_S) as endless,
        pytest.raises(OSError),
    ):
        for _ in range(64):
            endless.sendall(b"GET /" + b"a" * REQUEST_MAX_BYTES)
        if not endless.recv(1):
            raise ConnectionResetError


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_kernel_names_the_user_of_a_connection(
    host: str, scrape_server: Callable[..., ScrapeServer]
) -> None:
    named: list[int | None] = []
    seen = threading.Event()

    def owner(peer: tuple[str, int]) -> int | None:
        named.append(KernelTable()(peer))
        seen.set()
        return named[-1]

    try:
        server = scrape_server(lambda: owner, host=host)
    except OSError as error:
        pytest.skip(f"no {host} here: {error}")
    with socket.create_connection((host, server.port), PATIENCE_S):
        assert seen.wait(PATIENCE_S)
    assert named == [os.getuid()]
    assert KernelTable()((host, 1)) is None


def test_pages_are_made_at_most_every_so_often() -> None:
    """A flood of requests costs the program no more than a few pages a second."""
    made: list[str] = []

    def page(accept: str) -> tuple[bytes, str]:
        made.append(accept)
        return b"", "text/plain"

    server = ScrapeServer("127.0.0.1", 0, page)
    try:
        request = b"GET /metrics HTTP/1.1\r\nAccept: %s\r\n\r\n"
        began = time.monotonic()
        for accept in (b"*/*", scrapes.OPENMETRICS.encode()) * 20:
            server._answer(request % accept)
        intervals = 1 + (time.monotonic() - began) // scrapes.PAGE_S
        assert set(made) == {"", scrapes.OPENMETRICS}
        assert len(made) <= 2 * intervals
    finally:
        server.close()
