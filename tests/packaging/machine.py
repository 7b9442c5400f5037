"""A machine with a real systemd as its PID 1, in namespaces of its own: `boot_machine.sh` says what
it is made of.

It ends with its PID 1, however the test ends: the kernel then ends every process of it and its
mounts go.
"""

import contextlib
import json
import os
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import Any

from tests.packaging.installed import DEPENDENCIES, PYTHON, install_into
from tests.support.paths import ROOT

SYSTEMD = Path("/lib/systemd/systemd")
TOOLS = ("unshare", "nsenter", "setpriv", "pivot_root", "systemctl", "ldconfig")
BOOT_S = 60.0
PATIENCE_S = 180.0
PATH = "/usr/local/bin:/usr/sbin:/usr/bin:/sbin:/bin"


def obstacle() -> str | None:
    """Why no systemd can be started here; None if one can."""
    if os.getuid() != 0:
        return "needs root: a systemd is started in namespaces of its own"
    if missing := [tool for tool in TOOLS if shutil.which(tool, path=PATH) is None]:
        return f"not installed: {', '.join(missing)}"
    if not SYSTEMD.exists():
        return f"{SYSTEMD} is not installed"
    if "overlay" not in Path("/proc/filesystems").read_text().split():
        return "the kernel has no overlay file system"
    try:
        _own_cgroup().joinpath(f"vram-probe-{os.getpid()}").mkdir()
        _own_cgroup().joinpath(f"vram-probe-{os.getpid()}").rmdir()
    except (OSError, LookupError) as error:
        return f"no writable cgroup v2 hierarchy: {error}"
    namespaces = ["--fork", "--pid", "--mount", "--uts", "--ipc", "--net", "--cgroup"]
    tried = subprocess.run(
        ["unshare", *namespaces, "mount", "-t", "tmpfs", "tmpfs", "/run"],
        capture_output=True, text=True, timeout=30,
    )  # fmt: skip
    return f"namespaces are not permitted: {tried.stderr.strip()}" if tried.returncode else None


def _own_cgroup() -> Path:
    """Folder of this process in the cgroup v2 hierarchy. Raises LookupError where there is none."""
    for line in Path("/proc/self/mountinfo").read_text().splitlines():
        before, _, after = line.partition(" - ")
        if after.split()[0] == "cgroup2":
            own = next(
                entry.removeprefix("0::")
                for entry in Path("/proc/self/cgroup").read_text().splitlines()
                if entry.startswith("0::")
            )
            return Path(before.split()[4]) / own.strip("/")
    raise LookupError("not mounted")


class Machine:
    """Booted when made; `close` ends it. Its /opt/vram-arbiter holds the installed product, its
    /opt/tree the checkout."""

    def __init__(self) -> None:
        self._init: int | None = None  # pidfd
        self._init_pid = 0
        self._process: subprocess.Popen[bytes] | None = None
        self._answering: subprocess.Popen[str] | None = None
        self._scratch = Path(tempfile.mkdtemp(prefix="vram-machine-"))
        self._cgroup = _own_cgroup() / self._scratch.name  # a process may have several machines
        self.prefix = self._scratch / "prefix"
        """The machine's /opt/vram-arbiter, which is read-only inside."""
        try:
            self._prepare()
            self._boot()
        except BaseException:
            self.close()
            raise

    def _prepare(self) -> None:
        self._scratch.chmod(0o755)
        for name in ("notify", "layers"):
            (self._scratch / name).mkdir()
        install_into(
            self.prefix,
            seen_at=Path("/opt/vram-arbiter"),
            python=Path("/opt/python") / PYTHON.relative_to(sys.base_prefix),
            dependencies=Path("/opt/site-packages"),
        )
        self._cgroup.mkdir()

    def _boot(self) -> None:
        with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as notify:
            notify.bind(str(self._scratch / "notify" / "socket"))
            boot = [
                "unshare", "--fork", "--kill-child", "--pid", "--mount", "--uts", "--ipc", "--net",
                "--cgroup",
                str(Path(__file__).with_name("boot_machine.sh")), str(self._scratch), str(ROOT),
                str(self.prefix), sys.base_prefix, str(DEPENDENCIES),
            ]  # fmt: skip
            into_cgroup = (
                f'echo $$ >{self._cgroup}/cgroup.procs && exec setpriv --pdeathsig KILL "$@"'
            )
            with (self._scratch / "console").open("wb") as console:
                self._process = subprocess.Popen(
                    ["sh", "-c", into_cgroup, "sh", *boot],
                    stdin=subprocess.DEVNULL, stdout=console, stderr=console,
                )  # fmt: skip
            gone = os.pidfd_open(self._process.pid)
            try:
                deadline = time.monotonic() + BOOT_S
                while True:
                    left_s = max(0.0, deadline - time.monotonic())
                    readable, _, _ = select.select([notify, gone], [], [], left_s)
                    if notify in readable and b"READY=1" in notify.recv(4096):
                        break
                    if not readable or gone in readable:
                        raise RuntimeError(f"systemd did not come up:\n{self.console}")
            finally:
                os.close(gone)
        children = (
            Path(f"/proc/{self._process.pid}/task/{self._process.pid}/children").read_text().split()
        )
        self._init_pid = int(children[0])
        self._init = os.pidfd_open(self._init_pid)

    @property
    def console(self) -> str:
        return (self._scratch / "console").read_text(errors="replace")

    def inside(self, *command: str, user: str | None = None) -> list[str]:
        """The command line that runs a command on the machine."""
        enter = ["nsenter", f"--target={self._init_pid}", "--all", "env", "-i", f"PATH={PATH}"]
        become = ["setpriv", f"--reuid={user}", f"--regid={user}", "--init-groups"] if user else []
        return [*enter, *become, *command]

    def run(self, *command: str, user: str | None = None, code: int = 0, stdin: str = "") -> str:
        """Run a command on the machine; returns what it printed. Fails the test at another exit
        code."""
        done = subprocess.run(
            self.inside(*command, user=user),
            input=stdin, capture_output=True, text=True, timeout=PATIENCE_S,
        )  # fmt: skip
        said = f"{' '.join(command)}: exit code {done.returncode}\n{done.stdout}\n{done.stderr}"
        assert done.returncode == code, f"{said}\n{self.console}"
        return done.stdout

    def answer(self, code: str, line: str) -> Any:
        """Return what a Python program on the machine answers to a line, in JSON. It runs as root,
        from the first question on."""
        if self._answering is None:
            self._answering = subprocess.Popen(
                self.inside("/opt/vram-arbiter/bin/python", "-c", code),
                stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, bufsize=1,
            )  # fmt: skip
        assert self._answering.stdout is not None
        self._answering.stdin.write(f"{line}\n")
        return json.loads(self._answering.stdout.readline())

    def write(self, path: str, text: str) -> None:
        self.run("sh", "-c", f'mkdir -p "$(dirname {path})" && cat >{path}', stdin=text)

    def read(self, path: str) -> str:
        return self.run("cat", path)

    def show(self, unit: str, *properties: str) -> list[str]:
        said = self.run("systemctl", "show", unit, *(f"--property={name}" for name in properties))
        found = dict(line.split("=", 1) for line in said.splitlines())
        return [found[name] for name in properties]

    def start(self, unit: str) -> None:
        """Start a unit. Fails the test with the unit's log if it does not come up."""
        done = subprocess.run(
            self.inside("systemctl", "start", unit),
            capture_output=True,
            text=True,
            timeout=2 * PATIENCE_S,
        )
        assert done.returncode == 0, f"{done.stderr}\n{self.log(unit)}\n{self.console}"

    def log(self, unit: str) -> str:
        return self.run("sh", "-c", f"cat /run/logs/{unit}.log 2>/dev/null || true")

    def close(self) -> None:
        if self._process is not None:
            with contextlib.suppress(ProcessLookupError):
                if self._init is not None:
                    signal.pidfd_send_signal(self._init, signal.SIGKILL)
                else:
                    self._process.kill()
            self._process.wait(PATIENCE_S)
        if self._init is not None:
            os.close(self._init)
        if self._answering is not None:  # ended with the machine
            self._answering.communicate()
        if self._cgroup.exists():
            self._remove_cgroup()
        shutil.rmtree(self._scratch)

    def _remove_cgroup(self) -> None:
        """The kernel says when the last process has left: that may be after it was waited for."""
        with (self._cgroup / "cgroup.events").open() as events:
            changed = select.poll()
            changed.register(events, select.POLLPRI)
            while "populated 1" in events.read():
                assert changed.poll(1e3 * PATIENCE_S), f"{self._cgroup} is still in use"
                events.seek(0)
        for folder, _, _ in os.walk(self._cgroup, topdown=False):
            os.rmdir(folder)
