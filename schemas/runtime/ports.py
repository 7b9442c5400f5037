"""TCP ports: one for a program that will listen later, and one that listens."""

import random
import socket
from pathlib import Path
from typing import Final

FIRST: Final = 20_000
EPHEMERAL: Final = Path("/proc/sys/net/ipv4/ip_local_port_range")


def free_port() -> int:
    """Return a port of 127.0.0.1 on which nothing listens now.

    Below the kernel's range for outgoing connections: a port of that range may belong to any
    connection of the machine before the program listens, seconds or minutes later (ip(7)). Raises
    OSError where none is free.
    """
    ports = range(FIRST, max(FIRST + 1, int(EPHEMERAL.read_text().split()[0])))
    for port in random.sample(ports, len(ports)):
        with socket.socket() as probe:
            try:
                probe.bind(("127.0.0.1", port))
            except OSError:
                continue
            return port
    raise OSError(f"no port of 127.0.0.1 from {ports.start} to {ports.stop - 1} is free")


def listen(host: str, port: int, backlog: int) -> socket.socket:
    """Return a socket that listens at an address, IPv4 or IPv6, whose connections send at once.

    Nagle's algorithm (RFC 9293, 3.7.4) keeps a small segment back until the one before is
    acknowledged, which Linux may put off for 40 ms. asyncio turns it off for its own sockets alone.
    Raises OSError.
    """
    family = socket.AF_INET6 if ":" in host else socket.AF_INET
    listening = socket.create_server((host, port), family=family, backlog=backlog)
    listening.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)  # connections inherit it
    return listening
