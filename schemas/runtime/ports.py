"""A TCP port for a program that will listen later."""

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
