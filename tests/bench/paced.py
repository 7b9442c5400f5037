"""Bare clients of a server with OpenAI's API. Requests come at a rate, whatever the answers take:
their times are counted from when they were due, so a server that is late is late for all.
"""

import json
import random
import select
import socket
import time
from collections import deque
from collections.abc import Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from urllib.parse import urlsplit

from tests.support.waiting import PATIENCE_S

LAST = b"0\r\n\r\n"
"""No event ends so."""


@dataclass(frozen=True, slots=True)
class Asked:
    """`first_s`: from when the request was due to the first byte of its answer. `late_s`: how late
    it was sent, by these clients' own fault or for want of a free connection."""

    first_s: float
    late_s: float


def request(path: str, body: object = None) -> bytes:
    if body is None:
        return f"GET {path} HTTP/1.1\r\nHost: localhost\r\n\r\n".encode()
    data = json.dumps(body).encode()
    return (
        f"POST {path} HTTP/1.1\r\nHost: localhost\r\nContent-Type: application/json\r\n"
        f"Content-Length: {len(data)}\r\n\r\n"
    ).encode() + data


def chat(tokens: int, token_s: float = 0.0) -> bytes:
    messages = [{"role": "user", "content": "where is the cup?"}]
    body = {"model": "chat", "stream": True, "messages": messages}
    return request("/v1/chat/completions", {**body, "max_tokens": tokens, "token_s": token_s})


@contextmanager
def connections(url: str, count: int) -> Iterator[list[socket.socket]]:
    with ExitStack() as stack:
        found = urlsplit(url)
        made = []
        for _ in range(count):
            one = socket.create_connection((found.hostname, found.port), PATIENCE_S)
            one.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
            made.append(stack.enter_context(one))
        yield made


def at_rate(url: str, clients: int, per_s: float, seconds: float, tokens: int) -> list[Asked]:
    """Ask `per_s` times a second, at random, over `clients` connections."""
    gaps = random.Random(clients)
    now = time.perf_counter
    answered: list[Asked] = []
    with connections(url, clients) as made:
        free, busy = deque(made), dict[int, list[float]]()
        by_number = {one.fileno(): one for one in made}
        endings = dict.fromkeys(by_number, b"")
        poll = select.poll()
        for one in made:
            poll.register(one, select.POLLIN)
        data = chat(tokens)
        due, ends = now(), now() + seconds
        while due < ends or busy:
            if due < ends and due <= now() and free:
                one = free.popleft()
                busy[one.fileno()] = [due, now() - due, 0.0]
                one.sendall(data)
                due += gaps.expovariate(per_s)
                continue
            wait_s = due - now() if due < ends and free else PATIENCE_S
            for number, _ in poll.poll(max(0.0, wait_s) * 1e3):
                came = by_number[number].recv(1 << 16)
                assert came, "the server hung up"
                times = busy[number]
                times[2] = times[2] or now() - times[0]
                endings[number] = (endings[number] + came)[-len(LAST) :]
                if endings[number] == LAST:
                    del busy[number]
                    answered.append(Asked(times[2], times[1]))
                    free.append(by_number[number])
    return answered


def read_all(url: str, asked: Sequence[bytes], size: int | None) -> float:
    """Ask once over each of several connections, and read all answers: so many bytes, or to their
    last chunk. Return bytes per second."""
    space, total = bytearray(1 << 20), 0
    began = time.perf_counter()
    with connections(url, len(asked)) as made:
        poll = select.poll()
        open_ = {one.fileno(): one for one in made}
        sizes, endings = dict.fromkeys(open_, 0), dict.fromkeys(open_, b"")
        for one, data in zip(made, asked, strict=True):
            one.sendall(data)
            poll.register(one, select.POLLIN)
        while open_:
            for number, _ in poll.poll(PATIENCE_S * 1e3):
                count = open_[number].recv_into(space)
                assert count, "the server hung up"
                total += count
                sizes[number] += count
                ending = endings[number] + space[max(0, count - len(LAST)) : count]
                endings[number] = ending[-len(LAST) :]
                if endings[number] == LAST if size is None else sizes[number] >= size:
                    poll.unregister(open_.pop(number))
    return total / (time.perf_counter() - began)
