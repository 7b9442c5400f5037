"""A robot's key, let in on the GPU server: its line of `authorized_keys` and its Unix user.

The line names each socket and port that sshd may open for the robot. For a socket that is
`permitopen="[PATH]:*"`: the manual speaks of ports alone, but OpenSSH compares a path with the same
list (tried with 9.2), and a version that did not would refuse it. The module must not know tunnels.
"""

import base64
import shlex
import subprocess
from dataclasses import dataclass
from pathlib import Path
from typing import Final

from vram_arbiter.schemas.errors import ConfigError, InstallFailed
from vram_arbiter.schemas.runtime.endpoints import SYSTEM_RUNTIME

KEYS: Final = Path("/etc/ssh/vram-guests")
"""One file for each user, as configs/ssh/vram-guests.conf tells sshd."""
GROUPS: Final = ("vram-arbiter", "vram-guests")
"""The one that may connect, and the one that makes its members guests."""
KEY_MAX_BYTES: Final = 16 * 1024
USER_EXISTS: Final = 9  # useradd(8)
_HINT: Final = "make one on the robot with `ssh-keygen -t ed25519`, and give its .pub file"


@dataclass(frozen=True, slots=True)
class Guest:
    """One robot. `key`: kind and base64, as `read_key` returns them; `sidecars`: those it may
    reach beside the arbiter; `doors`: ports of 127.0.0.1 that it may reach."""

    name: str
    key: str
    sidecars: tuple[str, ...] = ()
    doors: tuple[int, ...] = ()
    runtime: str = SYSTEM_RUNTIME

    @property
    def user(self) -> str:
        return f"vram-{self.name}"

    @property
    def file(self) -> Path:
        """Its `authorized_keys`."""
        return KEYS / self.user

    @property
    def reached(self) -> tuple[str, ...]:
        """What sshd opens for it: paths of sockets, then addresses."""
        sockets = [f"{self.runtime}/{name}.sock" for name in ("arbiter", *self.sidecars)]
        return (*sockets, *(f"127.0.0.1:{port}" for port in self.doors))

    @property
    def line(self) -> str:
        opened = (f"[{one}]:*" if one.startswith("/") else one for one in self.reached)
        permits = ",".join(f'permitopen="{one}"' for one in opened)
        return f"restrict,port-forwarding,{permits} {self.key} {self.name}"

    def commands(self) -> tuple[list[str], ...]:
        """Return the commands that let it in, for root: make the user, if there is none, put it
        into the groups, and write the line, which is read from standard input."""
        # the password is none, yet not locked: without PAM sshd refuses a locked account its key
        account = ["--no-create-home", "--home-dir", "/nonexistent", "--password", "*"]
        made = ["useradd", "--system", *account, "--shell", "/usr/sbin/nologin", self.user]
        joined = ["usermod", "--append", "--groups", ",".join(GROUPS), self.user]
        # sshd reads the file as the user
        return made, joined, ["install", "-D", "-m", "644", "/dev/stdin", str(self.file)]


def read_key(path: Path) -> str:
    """Return kind and base64 of the public key in a file. Raises ConfigError: what it is
    instead."""
    try:
        with path.open("rb") as file:
            text = file.read(KEY_MAX_BYTES).decode()
        if "PRIVATE KEY" in text:
            raise ConfigError(f"{path} is a private key, which stays on the robot", hint=_HINT)
        (line,) = (line for line in text.splitlines() if line.strip())
        kind, encoded, *_ = line.split()
        body = base64.b64decode(encoded, validate=True)
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: expected one public key: {error}", hint=_HINT) from error
    # RFC 4253, section 6.6: a key's body begins with the length and the name of its kind
    head = len(kind).to_bytes(4) + kind.encode()
    if not body.startswith(head) or len(body) == len(head):
        raise ConfigError(f"{path}: the key is damaged: its body is not of {kind}", hint=_HINT)
    return f"{kind} {encoded}"


def install(guest: Guest) -> None:
    """Run the commands, as root; a key that the user had is replaced. Raises InstallFailed."""
    for command in guest.commands():
        done = subprocess.run(
            command, input=f"{guest.line}\n", capture_output=True, text=True, check=False
        )
        if done.returncode not in (0, USER_EXISTS):
            raise InstallFailed(
                f"`{shlex.join(command)}` failed with {done.returncode}: {done.stderr.strip()}",
                hint="run it as root, after `vramctl install`, which makes the groups",
            )
