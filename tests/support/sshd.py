"""A real sshd for tests, in a mount namespace of its own: the machine's accounts, `/etc/ssh` and
`/run` stay as they are.

`users` are Unix users of that namespace alone, each with a key and an `authorized_keys`; `groups`
maps the name of a group to its members, and a name that this machine has keeps its number. With
`network` it also has a network namespace of its own, whose loopback can be silenced: packets are
lost as on a cut cable. Needs root; the test is skipped elsewhere, with the reason.
"""

import grp
import os
import shutil
import signal
import socket
import subprocess
import threading
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Self

import pytest

from tests.support.paths import ROOT
from tests.support.processes import alive, children
from tests.support.waiting import PATIENCE_S

SSHD = "/usr/sbin/sshd"
FIRST_UID = 5001
"""Of the users, one after the other; each has a group of the same number."""
FIRST_GID = 5901
"""Of groups that this machine does not have."""
RESTRICTED = "restrict,port-forwarding"
DROP_INS = ROOT / "configs/ssh"
CONFIG = """\
Include {drop_ins}/*.conf
Port {port}
ListenAddress 127.0.0.1
HostKey /etc/ssh/host_key
PidFile none
AuthorizedKeysFile /etc/ssh/vram-guests/%u
UsePAM no
PasswordAuthentication no
KbdInteractiveAuthentication no
LogLevel VERBOSE
"""
ENTER = """\
set -e
mount --bind "$1/passwd" /etc/passwd
mount --bind "$1/group" /etc/group
mount --bind "$1/ssh" /etc/ssh
mount -t tmpfs tmpfs /run
mkdir -m 0755 /run/sshd
[ -z "$2" ] || ip link set lo up
exec {sshd} -D -e -f /etc/ssh/sshd_config
"""


def unavailable() -> str:
    """Return why no sshd can be started here; "" if it can."""
    if os.getuid() != 0:
        return "needs root: sshd changes to the users' accounts"
    if not os.access(SSHD, os.X_OK):
        return f"no {SSHD}: apt install openssh-server"
    if subprocess.run(["unshare", "--mount", "--net", "true"], check=False).returncode:
        return "no namespaces: needs CAP_SYS_ADMIN"
    return ""


class Sshd:
    """`with Sshd(folder) as sshd:` listens on 127.0.0.1 until the end of the block."""

    def __init__(
        self,
        folder: Path,
        users: Sequence[str] = ("arm1",),
        groups: Mapping[str, Sequence[str]] | None = None,
        *,
        network: bool = False,
    ) -> None:
        self.folder = folder
        self.users = tuple(users)
        self.log: list[str] = []
        self.port = 0
        self.host_key_line = ""
        """The line of a `known_hosts` file."""
        self._groups = dict(groups or {})
        self._network = network
        self._listening = threading.Event()

    def __enter__(self) -> Self:
        if why := unavailable():
            pytest.skip(why)
        self._write_files()
        command = ["unshare", "--mount", *(["--net"] if self._network else []), "sh", "-c"]
        command += [ENTER.format(sshd=SSHD), "sh", str(self.folder), "1" if self._network else ""]
        self._process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        self._reader = threading.Thread(target=self._read, daemon=True)
        self._reader.start()
        if not self._listening.wait(PATIENCE_S):
            self.__exit__()
            raise AssertionError(f"sshd does not listen: {self.log}")
        return self

    def __exit__(self, *_: object) -> None:
        for pid in [*self._descendants(self._process.pid), self._process.pid]:
            _send(pid, signal.SIGKILL)
        self._process.wait(PATIENCE_S)
        self._reader.join(PATIENCE_S)
        assert self._process.stderr is not None
        self._process.stderr.close()

    def key(self, user: str) -> Path:
        """Return the private key of a user."""
        return self.folder / "keys" / user

    def authorized(self, user: str) -> Path:
        """Return the `authorized_keys` of a user, which has the one line of its key."""
        return self.folder / "ssh/vram-guests" / user

    def public_key(self, user: str) -> str:
        """Return the public key of a user: type, base64 and comment."""
        return self.key(user).with_suffix(".pub").read_text().strip()

    def uid(self, user: str) -> int:
        return FIRST_UID + self.users.index(user)

    def inside(self, *command: str) -> list[str]:
        """Return a command that runs in the namespaces of sshd."""
        spaces = ["--mount", *(["--net"] if self._network else [])]
        here = f"--wd={Path.cwd()}"
        return ["nsenter", f"--target={self._process.pid}", *spaces, here, *command]

    # -- sessions
    def children(self, user: str) -> list[int]:
        """Return the processes that connect on behalf of a user: one for each of its sessions, soon
        after the client has its forwarded sockets."""
        uid = self.uid(user)
        return [pid for pid in self._descendants(self._process.pid) if _runs_as(pid, uid)]

    def freeze(self, user: str) -> None:
        """Stop the processes of a user's sessions."""
        for pid in self.children(user):
            _send(pid, signal.SIGSTOP)

    def unfreeze(self, user: str) -> None:
        for pid in self.children(user):
            _send(pid, signal.SIGCONT)

    def kill(self, user: str) -> None:
        for pid in self.children(user):
            _send(pid, signal.SIGKILL)

    # -- the network
    def silence(self) -> None:
        """Lose every packet from now on; neither end hears of it."""
        self._link("down")

    def hear(self) -> None:
        """Let packets pass again."""
        self._link("up")

    def _link(self, state: str) -> None:
        assert self._network, "only in a network namespace of its own"
        subprocess.run(self.inside("ip", "link", "set", "lo", state), check=True)

    # -- parts
    def _write_files(self) -> None:
        ssh, keys = self.folder / "ssh", self.folder / "keys"
        (ssh / "vram-guests").mkdir(parents=True)
        keys.mkdir()
        if DROP_INS.is_dir():
            shutil.copytree(DROP_INS, ssh / "sshd_config.d")
        self.port = _free_port()
        drop_ins = "/etc/ssh/sshd_config.d"
        (ssh / "sshd_config").write_text(CONFIG.format(port=self.port, drop_ins=drop_ins))
        host_key = _keygen(ssh / "host_key")
        self.host_key_line = f"[127.0.0.1]:{self.port} {host_key}"
        for user in self.users:
            self.authorized(user).write_text(f"{RESTRICTED} {_keygen(self.key(user))}\n")
        self._write_accounts()

    def _write_accounts(self) -> None:
        """An account is a member of a group by each line that names it."""
        passwd, group = Path("/etc/passwd").read_text(), Path("/etc/group").read_text()
        for user in self.users:
            uid = self.uid(user)
            passwd += f"{user}:*:{uid}:{uid}::/nonexistent:/usr/sbin/nologin\n"
            group += f"{user}:x:{uid}:\n"
        for number, (name, members) in enumerate(self._groups.items(), FIRST_GID):
            group += f"{name}:x:{_gid(name, number)}:{','.join(members)}\n"
        (self.folder / "passwd").write_text(passwd)
        (self.folder / "group").write_text(group)

    def _read(self) -> None:
        assert self._process.stderr is not None
        for line in self._process.stderr:
            self.log.append(line.rstrip())
            if "Server listening on" in line:
                self._listening.set()

    def _descendants(self, pid: int) -> list[int]:
        try:
            own = children(pid)
        except OSError:
            return []
        return [below for child in own for below in (*self._descendants(child), child)]


def _keygen(path: Path) -> str:
    """Make a key, and return its public half."""
    command = ["ssh-keygen", "-q", "-t", "ed25519", "-N", "", "-C", path.name, "-f", str(path)]
    subprocess.run(command, check=True)
    return path.with_suffix(".pub").read_text().strip()


def _gid(name: str, fallback: int) -> int:
    try:
        return grp.getgrnam(name).gr_gid
    except KeyError:
        return fallback


def _runs_as(pid: int, uid: int) -> bool:
    """Return whether a process lives and has all of its privileges from this user. The owner of its
    folder in /proc does not tell: it is root for a process that has changed its user."""
    try:
        status = Path(f"/proc/{pid}/status").read_text() if alive(pid) else ""
    except OSError:
        return False
    return f"Uid:\t{uid}\t{uid}\t{uid}\t" in status


def _send(pid: int, number: signal.Signals) -> None:
    try:
        os.kill(pid, number)
    except ProcessLookupError:
        return


def _free_port() -> int:
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        port: int = taken.getsockname()[1]
        return port
