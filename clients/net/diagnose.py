"""What the kernel says at once about a socket that does not answer.

libzmq connects in silence, again and again: a forbidden socket or a killed arbiter looks like an
arbiter that is slow.
"""

import errno
import grp
import os
import socket
import stat
from typing import Final

from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.runtime.endpoints import socket_path

START: Final = "start `vram-arbiter`, or set VRAM_ARBITER_ENDPOINT"
PATIENCE_S: Final = 1.0


def obstacle(endpoint: str) -> tuple[str, str] | None:
    """What is wrong with an endpoint and what to do; None if it can be connected to, or only trying
    can tell."""
    try:
        path = socket_path(endpoint)
    except ConfigError as error:
        return error.message, error.hint
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(PATIENCE_S)
        try:
            probe.connect(path)
        except FileNotFoundError:
            return f"no arbiter at {endpoint}: the socket does not exist", START
        except PermissionError:
            return f"{endpoint} may not be used by uid {os.geteuid()}: permission denied", _who_may(
                path
            )
        except ConnectionRefusedError:
            if stat.S_ISSOCK(os.stat(path).st_mode):
                return f"no arbiter at {endpoint}: it was killed, its socket is left over", START
            return f"{endpoint} is not a socket", START
        except TimeoutError:
            return None  # its queue of connections is full: it lives
        except OSError as error:
            if error.errno == errno.EAGAIN:
                return None
            return f"{endpoint} is not an endpoint: {error.strerror or error}", START
    return None


def _who_may(path: str) -> str:
    """Name the group that may use a socket: its own, or that of the folder which hides it."""
    place, opens, hidden = path, stat.S_IWGRP, ""
    while True:
        try:
            found = os.stat(place)
            break
        except OSError:
            if place in ("/", ""):
                return "its folder is closed to you: use its user, or root"
            place, opens, hidden = (
                os.path.dirname(place),
                stat.S_IXGRP,
                "its folder is closed to you: ",
            )
    if not stat.S_IMODE(found.st_mode) & opens:
        only = "use its user, or root" if hidden else "only its own user may: use it, or root"
        return f"{hidden}{only}; wire.group opens it to a group"
    try:
        group = grp.getgrgid(found.st_gid).gr_name
    except KeyError:
        group = str(found.st_gid)
    return f"{hidden}join the group {group} (log in again), or use root"
