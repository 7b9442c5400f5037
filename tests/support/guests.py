"""A GPU server with one robot behind ssh: an arbiter with groups, a real sshd, and ssh's tunnel.

The robot is the guest `arm1`. Its key's line is the one that `vramctl remote authorize` writes, and
sshd has the product's own drop-in, so the daemon knows the guests' group by a number alone.
"""

import contextlib
import subprocess
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from tests.support.process import Make
from tests.support.sshd import Sshd
from tests.support.waiting import until
from vram_arbiter.clients.remote.authorize import Guest

MEMBERS, GUESTS = "users", "games"
"""Groups that each machine has: of the socket, and of guests."""
USER = "arm1"


class Server:
    """`environ` and `endpoint` are of the arbiter's own machine."""

    def __init__(self, make_arbiter: Make, folder: Path, users: tuple[str, ...], **options: Any):
        arguments = ("--group", MEMBERS, "--guests-group", GUESTS)
        self.arbiter = make_arbiter(arguments=arguments).start()
        self.arbiter.runtime.chmod(0o711)  # the folder of the units is open to the group
        groups = {MEMBERS: users, GUESTS: users, "vram-guests": users}
        self.sshd = Sshd(folder, users, groups, **options)
        self.endpoint = self.arbiter.endpoint

    def authorize(self, user: str = USER, *sidecars: str, doors: tuple[int, ...] = ()) -> None:
        key = " ".join(self.sshd.public_key(user).split()[:2])
        guest = Guest(user, key, sidecars, doors, str(self.arbiter.runtime))
        self.sshd.authorized(user).write_text(f"{guest.line}\n")

    @contextlib.contextmanager
    def ssh(self, *arguments: str, user: str = USER) -> Iterator["subprocess.Popen[str]"]:
        """An ssh of the robot; the robot is in the network of sshd."""
        known = self.sshd.folder / "known_hosts"
        known.write_text(f"{self.sshd.host_key_line}\n")
        options = {
            "UserKnownHostsFile": known,
            "BatchMode": "yes",
            "ExitOnForwardFailure": "yes",
            "LogLevel": "ERROR",
        }
        words = [word for key, value in options.items() for word in ("-o", f"{key}={value}")]
        words += ["-F", "none", "-i", str(self.sshd.key(user)), "-p", str(self.sshd.port)]
        command = self.sshd.inside("ssh", *words, f"{user}@127.0.0.1", *arguments)
        with subprocess.Popen(
            command, stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
            text=True,
        ) as ssh:  # fmt: skip
            try:
                yield ssh
            finally:
                ssh.kill()

    @contextlib.contextmanager
    def tunnel(self, user: str = USER) -> Iterator[tuple["subprocess.Popen[str]", str]]:
        """A tunnel to the arbiter: ssh, and the robot's endpoint."""
        here = self.sshd.folder / f"{user}.sock"
        there = self.endpoint.removeprefix("ipc://")
        with self.ssh("-N", "-L", f"{here}:{there}", user=user) as ssh:
            until(lambda: here.exists() or ssh.poll() is not None)
            until(lambda: self.sshd.children(user) or ssh.poll() is not None)
            assert ssh.poll() is None, self.sshd.log
            yield ssh, f"ipc://{here}"
        here.unlink(missing_ok=True)


@contextlib.contextmanager
def sshd_server(
    make_arbiter: Make, folder: Path, users: tuple[str, ...] = (USER,), **options: Any
) -> Iterator[Server]:
    """Start both; `options` are those of `Sshd`."""
    one = Server(make_arbiter, folder, users, **options)
    with one.sshd:
        for user in users:
            one.authorize(user)
        yield one
