"""The machine as the checks of `vramctl doctor` see it.

Files are read below `root`, so a test can lay out a machine of its own. What the arbiter and NVML
say is asked once, before the checks run. Nothing is changed.
"""

import contextlib
import grp
import os
import pwd
import socket
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook
from vram_arbiter.clients.net import request
from vram_arbiter.schemas.codec import CodecError, from_map
from vram_arbiter.schemas.errors import ConfigError, VramError
from vram_arbiter.schemas.runtime.endpoints import SYSTEM_RUNTIME, socket_path
from vram_arbiter.schemas.runtime.nvml import devices
from vram_arbiter.schemas.runtime.peercred import credentials
from vram_arbiter.schemas.runtime.version import version
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.replies import PingReply, StatusReply
from vram_arbiter.schemas.wire.requests import Ping, Status

CONNECT_S: Final = 1.0
UNIT: Final = "vram-arbiter.service"


@dataclass(frozen=True, slots=True)
class Nvml:
    """What NVML says. `problem`: why it does not work, under the name of its error class."""

    version: str = ""
    gpus: int = 0  # MIG instances too
    without_memory: bool = False  # Jetson and GB10: their memory is the machine's
    problem: str = ""
    error: str = ""


@dataclass(frozen=True, slots=True)
class Arbiter:
    """What the arbiter at the endpoint says. `status` None: it does not answer, `problem` says why;
    `refusal`: it answered with an error."""

    status: StatusReply | None = None
    server: str = ""  # its version
    pid: int | None = None  # 0: of another pid namespace
    uid: int | None = None
    problem: VramError | None = None
    refusal: ErrorView | None = None


@dataclass(frozen=True)
class Machine:
    """All that checks may look at."""

    endpoint: str
    arbiter: Arbiter
    version: str  # of this program
    nvml: Nvml = field(default_factory=Nvml)
    root: Path = Path("/")
    environ: Mapping[str, str] = field(default_factory=dict)
    uid: int = 0
    gids: frozenset[int] = frozenset({0})
    group_name: Callable[[int], str] = str
    group_members: Callable[[str], Sequence[str]] = lambda name: ()
    user_name: Callable[[int], str] = str

    # -- files
    def path(self, name: str) -> Path:
        """Return the place of an absolute path of this machine."""
        return self.root / name.lstrip("/")

    def text(self, name: str) -> str | None:
        """Return a file's text; None where there is none. Raises CouldNotLook."""
        return self._looked(name, lambda place: place.read_text(errors="replace"))

    def exists(self, name: str) -> bool:
        """Whether there is such a file, also a link that leads nowhere. Raises CouldNotLook."""
        return self._looked(name, os.lstat) is not None

    def names(self, folder: str) -> list[str]:
        """Return the names in a folder, sorted; none where there is no folder. Raises
        CouldNotLook."""
        return sorted(self._looked(folder, os.listdir) or ())

    def stat(self, name: str) -> os.stat_result | None:
        """Return what the file system says of a file; None where there is none. Raises
        CouldNotLook."""
        return self._looked(name, os.stat)

    def _looked[T](self, name: str, look: Callable[[Path], T]) -> T | None:
        try:
            return look(self.path(name))
        except (FileNotFoundError, NotADirectoryError, ProcessLookupError):
            return None
        except OSError as error:
            raise CouldNotLook(f"{name}: {error.strerror}") from error

    def may(self, found: os.stat_result, needed: int) -> bool:
        """Whether this user has the permission bits `needed` (4 read, 2 write, 1 search)."""
        shift = 6 if found.st_uid == self.uid else 3 if found.st_gid in self.gids else 0
        return self.uid == 0 or (found.st_mode >> shift) & needed == needed

    # -- processes
    def command_line(self, pid: int) -> list[str]:
        """Return the arguments of a process; none of one that ended."""
        with contextlib.suppress(CouldNotLook):
            return (self.text(f"/proc/{pid}/cmdline") or "").rstrip("\0").split("\0")
        return []

    def daemon_file(self, name: str) -> str:
        """Return a file of the daemon's folder in /proc. Raises CouldNotLook."""
        pid = self.arbiter.pid
        if not pid:
            why = "it belongs to a pid namespace that cannot be seen from here"
            raise CouldNotLook("no arbiter answers" if pid is None else f"the arbiter: {why}")
        found = self.text(f"/proc/{pid}/{name}")
        if found is None:
            raise CouldNotLook(f"/proc/{pid}/{name} is not there")
        return found

    # -- commands of a fix
    @property
    def sudo(self) -> str:
        return "" if self.uid == 0 else "sudo "

    @property
    def socket(self) -> str:
        """Path of the endpoint's socket. Raises CouldNotLook."""
        try:
            return socket_path(self.endpoint)
        except ConfigError as error:
            raise CouldNotLook(error.message) from error

    @property
    def is_system(self) -> bool:
        """Whether the endpoint is the one of the system's unit."""
        return self.endpoint.startswith(f"ipc://{SYSTEM_RUNTIME}/")

    def service(self, action: str) -> str:
        """Return the command that starts, or restarts, the arbiter of this endpoint."""
        if self.is_system:
            return f"{self.sudo}systemctl {action} vram-arbiter"
        unit = any(self.exists(f"{folder}/{UNIT}") for folder in user_folders(self.environ))
        if unit and self.endpoint.startswith("ipc:///run/user/"):
            return f"systemctl --user {action} vram-arbiter"
        stop = f"kill {self.arbiter.pid}; " if action == "restart" and self.arbiter.pid else ""
        return f"{stop}vram-arbiter --endpoint {self.endpoint}"


def user_folders(environ: Mapping[str, str]) -> tuple[str, ...]:
    """Return the folders of user units, the user's own first."""
    home = environ.get("XDG_CONFIG_HOME") or f"{environ.get('HOME', '/root')}/.config"
    return (f"{home}/systemd/user", "/etc/systemd/user", "/usr/lib/systemd/user")


# -- this machine
def this_machine(endpoint: str, nvml: Nvml) -> Machine:
    """Look at the machine that this program runs on."""
    return Machine(
        endpoint=endpoint,
        arbiter=ask_arbiter(endpoint),
        version=version(),
        nvml=nvml,
        environ=os.environ,
        uid=os.geteuid(),
        gids=frozenset({os.getegid(), *os.getgroups()}),
        group_name=lambda gid: _found(lambda key: grp.getgrgid(key).gr_name, gid, str(gid)),
        group_members=lambda name: _found(lambda key: grp.getgrnam(key).gr_mem, name, []),
        user_name=lambda uid: _found(lambda key: pwd.getpwuid(key).pw_name, uid, str(uid)),
    )


def ask_arbiter(endpoint: str) -> Arbiter:
    """Ask the arbiter, and the kernel for its pid and uid."""
    try:
        status = request.ask(Status(), endpoint)
        pid, uid = _listener(endpoint)
        if not status.get("ok"):
            error = status["error"]
            view = ErrorView(error["code"], error["message"], error.get("hint", ""), {})
            return Arbiter(pid=pid, uid=uid, refusal=view)
        server = from_map(PingReply, request.ask(Ping(), endpoint)).server
        return Arbiter(from_map(StatusReply, status), server, pid, uid)
    except VramError as error:
        return Arbiter(problem=error)
    except (CodecError, KeyError) as error:
        view = ErrorView("internal", f"its answer is not understood: {error}", "", {})
        return Arbiter(refusal=view)


def _listener(endpoint: str) -> tuple[int | None, int | None]:
    with socket.socket(socket.AF_UNIX, socket.SOCK_STREAM) as probe:
        probe.settimeout(CONNECT_S)
        try:
            probe.connect(socket_path(endpoint))
            pid, uid, _ = credentials(probe)
        except (OSError, ConfigError):
            return None, None
    return pid, uid


def ask_nvml() -> Nvml:
    """Ask NVIDIA's library. The daemon, not this program, decides what is leased."""
    import pynvml

    try:
        pynvml.nvmlInit()
    except pynvml.NVMLError as error:
        return Nvml(problem=str(error), error=type(error).__name__)
    try:
        version = pynvml.nvmlSystemGetDriverVersion()
        gpus = devices(pynvml)
        for gpu in gpus:
            try:
                pynvml.nvmlDeviceGetMemoryInfo(gpu.handle)
            except pynvml.NVMLError_NotSupported:
                return Nvml(version, len(gpus), without_memory=True)
    except (pynvml.NVMLError, ConfigError) as error:
        return Nvml(problem=str(error), error=type(error).__name__)
    finally:
        pynvml.nvmlShutdown()
    return Nvml(version, len(gpus))


def unix_sockets(machine: Machine) -> Mapping[str, bool]:
    """Return the paths of bound unix sockets by the kernel's table, and which of them listen.
    Raises CouldNotLook."""
    table = machine.text("/proc/net/unix")
    if table is None:
        raise CouldNotLook("/proc/net/unix is not there")
    found: dict[str, bool] = {}
    for line in table.splitlines()[1:]:
        words = line.split(maxsplit=7)
        if len(words) == 8:
            found[words[7]] = found.get(words[7], False) or bool(int(words[3], 16) & _LISTENS)
    return found


_LISTENS: Final = 0x10000  # __SO_ACCEPTCON, linux/net.h


def _found[K, T](look: Callable[[K], T], key: K, otherwise: T) -> T:
    """Return what the account database says; `otherwise` where it knows no such name or number."""
    try:
        return look(key)
    except KeyError:
        return otherwise
