"""A robot's key, let in on the GPU server: its line of `authorized_keys` and its Unix user.

The line names each socket and port that sshd may open for the robot. For a socket that is
`permitopen="[PATH]:*"`: the manual speaks of ports alone, but OpenSSH compares a path with the same
list (tried with 9.2), and a version that did not would refuse it. The module must not know tunnels.
"""

import base64
import binascii
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
NAME: Final = r"[a-z][a-z0-9_-]{0,26}"
"""Of a robot: with `vram-` before it, the name of a Unix user."""
SIDECAR: Final = r"[A-Za-z0-9_][A-Za-z0-9_.-]{0,63}"
FOLDER: Final = r"(/[A-Za-z0-9_.@+-]+)+"
"""As SIDECAR without what has a meaning in the line: quotes, commas, brackets, blanks."""
KEY_MAX_BYTES: Final = 16 * 1024
KINDS: Final = (
    "ssh-ed25519", "sk-ssh-ed25519@openssh.com", "ecdsa-sha2-nistp256", "ecdsa-sha2-nistp384",
    "ecdsa-sha2-nistp521", "sk-ecdsa-sha2-nistp256@openssh.com", "ssh-rsa",
)  # fmt: skip
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
    keys: Path = KEYS

    @property
    def user(self) -> str:
        return f"vram-{self.name}"

    @property
    def file(self) -> Path:
        """Its `authorized_keys`."""
        return self.keys / self.user

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

    def commands(self, *, exists: bool) -> list[list[str]]:
        """Return the commands that make the user, or that put one that exists into the groups."""
        groups = ["--groups", ",".join(GROUPS), self.user]
        if exists:
            return [["usermod", "--append", *groups]]
        # the password is none, yet not locked: without PAM sshd refuses a locked account its key
        account = ["--no-create-home", "--home-dir", "/nonexistent", "--password", "*"]
        return [["useradd", "--system", *account, "--shell", "/usr/sbin/nologin", *groups]]


def read_key(path: Path) -> str:
    """Return kind and base64 of the public key in a file. Raises ConfigError: what it is
    instead."""
    try:
        with path.open("rb") as file:
            text = file.read(KEY_MAX_BYTES).decode()
    except (OSError, UnicodeDecodeError) as error:
        raise ConfigError(f"{path}: cannot be read as a public key: {error}", hint=_HINT) from error
    if "PRIVATE KEY" in text:
        raise ConfigError(f"{path} is a private key, which stays on the robot", hint=_HINT)
    lines = [line for line in text.splitlines() if line.strip()]
    if len(lines) != 1:
        raise ConfigError(f"{path}: expected one public key, got {len(lines)} lines", hint=_HINT)
    kind, _, rest = lines[0].strip().partition(" ")
    if kind not in KINDS:
        raise ConfigError(
            f"{path}: expected a key of {', '.join(KINDS)}, got {kind[:40]!r}", hint=_HINT
        )
    encoded = rest.strip().partition(" ")[0]
    try:
        body = base64.b64decode(encoded, validate=True)
    except binascii.Error as error:
        raise ConfigError(f"{path}: the key is damaged: {error}", hint=_HINT) from error
    # RFC 4253, section 6.6: a key's body begins with the length and the name of its kind
    if not body.startswith(len(kind).to_bytes(4) + kind.encode()) or len(body) <= 4 + len(kind):
        raise ConfigError(f"{path}: the key is damaged: its body is not of {kind}", hint=_HINT)
    return f"{kind} {encoded}"


def install(guest: Guest, *, exists: bool) -> None:
    """Make the user and write its key, as root; a key that it had is replaced. Raises
    InstallFailed."""
    for command in guest.commands(exists=exists):
        done = subprocess.run(command, capture_output=True, text=True, check=False)
        if done.returncode:
            raise InstallFailed(
                f"`{shlex.join(command)}` failed with {done.returncode}: {done.stderr.strip()}",
                hint="run `sudo vramctl install` first: it makes the groups",
            )
    try:
        guest.keys.mkdir(mode=0o755, exist_ok=True)
        guest.file.write_text(f"{guest.line}\n")
        guest.file.chmod(0o644)  # sshd reads it as the user
    except OSError as error:
        raise InstallFailed(f"{guest.file}: {error.strerror}", hint="run it as root") from error
