"""A robot beside a GPU server on one machine: `vramctl remote` in a folder of the robot's own.

Sockets of the server are in its arbiter's runtime folder.
"""

import json
import os
import shutil
import subprocess
import sys
import tempfile
from pathlib import Path
from typing import Any, Self

from tests.support.guests import USER, Server
from tests.support.process import Make, vramctl


class Remote:
    """`with Remote(make_arbiter, folder) as remote:`; the robot may reach the arbiter and the
    sidecar `grab`."""

    def __init__(self, make_arbiter: Make, folder: Path) -> None:
        self._server = Server(make_arbiter, folder / "sshd", (USER,))
        self.arbiter, self.sshd = self._server.arbiter, self._server.sshd
        self.robot = Path(tempfile.mkdtemp(prefix="vr"))
        self.known_hosts = self.robot / "config/vram-arbiter/known_hosts"
        self._keepers: list[subprocess.Popen[str]] = []

    def __enter__(self) -> Self:
        self.sshd.__enter__()
        self.known_hosts.parent.mkdir(parents=True)
        self.known_hosts.write_text(self.sshd.host_key_line + "\n")
        self.authorize()
        return self

    def __exit__(self, *_: object) -> None:
        for keeper in self._keepers:
            keeper.terminate()
            keeper.communicate()
        self.sshd.__exit__()
        shutil.rmtree(self.robot)

    def authorize(self, *doors: int) -> None:
        """Let the robot's key in, also to ports of doors."""
        self._server.authorize(USER, "grab", doors=doors)

    @property
    def sidecar(self) -> Path:
        """The socket of `grab` on the server; its own group is the test's."""
        return self.arbiter.runtime / "grab.sock"

    @property
    def host(self) -> str:
        return f"{USER}@127.0.0.1:{self.sshd.port}"

    @property
    def folder(self) -> Path:
        """The robot's folder of forwarded sockets."""
        return self.robot / "remote" / self.host.replace(":", ",")

    @property
    def endpoint(self) -> str:
        """The server's arbiter, as the robot has it."""
        return f"ipc://{self.folder}/arbiter.sock"

    @property
    def environ(self) -> dict[str, str]:
        """Of the robot's programs."""
        kept = {k: v for k, v in os.environ.items() if not k.startswith("VRAM_ARBITER_")}
        own = {
            "VRAM_ARBITER_RUNTIME": str(self.robot),
            "XDG_CONFIG_HOME": str(self.robot / "config"),
        }
        return kept | own

    def keeper(self, *arguments: str, host: str = "") -> subprocess.Popen[str]:
        """Start `vramctl remote up`."""
        command = [sys.executable, "-m", "vram_arbiter.clients", "remote", "up"]
        command += [host or self.host, *arguments]
        command += ["--server-runtime", str(self.arbiter.runtime)]
        command += ["--identity", str(self.sshd.key(USER))]
        started = subprocess.Popen(command, env=self.environ, stderr=subprocess.PIPE, text=True)
        self._keepers.append(started)
        return started

    def up(self, *arguments: str) -> subprocess.Popen[str]:
        """Start it, and wait until the tunnel is up."""
        started = self.keeper(*arguments)
        wait_for_line(started, "is up")
        return started

    def status(self) -> list[dict[str, Any]]:
        """Return what `vramctl remote status` says."""
        told = vramctl("remote", "status", "--json", environ=self.environ)
        return list(json.loads(told.stdout)["tunnels"])


def wait_for_line(keeper: subprocess.Popen[str], word: str) -> str:
    """Return the keeper's next line that has a word."""
    assert keeper.stderr is not None
    said = []
    for line in keeper.stderr:
        said.append(line)
        if word in line:
            return line
    raise AssertionError(f"the keeper ended: {said}")
