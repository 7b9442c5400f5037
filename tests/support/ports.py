"""TCP ports of loopback for servers of tests."""

import socket


def free_port() -> int:
    """Return a port on which nothing listens; the next process that binds to any may take it."""
    with socket.create_server(("127.0.0.1", 0)) as server:
        port: int = server.getsockname()[1]
        return port
