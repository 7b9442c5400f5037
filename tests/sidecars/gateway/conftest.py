"""A gateway as a process before stand-in servers, beside a real daemon with a simulated GPU."""

import os
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import httpx
import pytest
import yaml

from tests.support.prepared import Forked, start
from tests.support.process import ArbiterProcess
from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.yamltext import TEXT_MAX_BYTES

KEY = "none-is-checked"


class GatewayProcess:
    """`vram-gateway serve`, forked where `prepared`. `url`: what it printed."""

    def __init__(
        self,
        arbiter: ArbiterProcess,
        config: dict[str, Any],
        folder: Path,
        *,
        prepared: bool = True,
    ) -> None:
        self.arbiter, self.folder = arbiter, arbiter.gpu_folder
        path = folder / "gateway.yaml"
        text = yaml.safe_dump(config)
        assert len(text) < TEXT_MAX_BYTES
        path.write_text(text)
        path.chmod(0o600)
        self.errors = (folder / "gateway.log").open("wb")
        self.process: Forked | subprocess.Popen[bytes]
        words, environ = ["serve", "--config", str(path)], {**os.environ, **arbiter.environ}
        said, says = os.pipe()
        with open(said, "rb") as output:
            if prepared:
                self.process = start("vram-gateway", words, environ, says, self.errors.fileno())
            else:
                command = [sys.executable, "-m", "vram_arbiter.sidecars.gateway", *words]
                self.process = subprocess.Popen(
                    command, env=environ, stdout=says, stderr=self.errors
                )
            os.close(says)
            self.url = output.readline().decode().strip()
        assert self.url, (folder / "gateway.log").read_text()
        # One for all: each new one reads the certificates of the machine for 60 ms of a core.
        self.client = httpx.Client(base_url=self.url, timeout=PATIENCE_S)

    def running(self) -> dict[str, dict[str, Any]]:
        """What `/running` says, by server."""
        found = self.client.get("/running").json()["running"]
        return {one["model"]: one for one in found}

    def pid_of(self, model: str) -> int:
        """Ask a stand-in for its pid, which starts it."""
        return int(self.client.get(f"/upstream/{model}/x").json()["pid"])

    def logs(self) -> str:
        return self.client.get("/logs").text

    def let(self, user: str, *numbers: int) -> None:
        """Let a stand-in go on with these words of a chat."""
        for number in numbers:
            (self.folder / f"{user}.{number}").touch()

    def close(self) -> None:
        self.client.close()
        self.process.send_signal(signal.SIGTERM)
        try:
            self.process.wait(PATIENCE_S)
        finally:
            self.process.kill()
            self.process.wait(PATIENCE_S)
            self.errors.close()


def stand_in(arbiter: ArbiterProcess, gib: float, **fields: Any) -> dict[str, Any]:
    """The configuration of a stand-in server."""
    size = str(int(gib * (1 << 30)))
    command = [sys.executable, "-m", "tests.support.openai_server", str(arbiter.gpu_folder), size]
    return {
        "command": [*command, "{port}"],
        "vram": f"{gib}GiB",
        "min_residency_s": 0.25,
        "grace_s": PATIENCE_S,
        "wait_s": PATIENCE_S,
        **fields,
    }


@pytest.fixture
def gateway(
    arbiter_daemon: ArbiterProcess, tmp_path: Path
) -> Iterator[Callable[..., GatewayProcess]]:
    """`gateway({"a": stand_in(…)}, keys_file=…)` starts one."""
    made: list[GatewayProcess] = []

    def begin(servers: dict[str, Any], *, prepared: bool = True, **fields: Any) -> GatewayProcess:
        config = {"listen": "127.0.0.1:0", "servers": servers, **fields}
        made.append(GatewayProcess(arbiter_daemon, config, tmp_path, prepared=prepared))
        return made[-1]

    yield begin
    for one in made:
        one.close()


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[GatewayProcess]:
    """One gateway and daemon for the tests of a file: either of the servers `a` and `b` fits."""
    arbiter = ArbiterProcess(prepared=True)
    try:
        arbiter.start()
        config = {
            "listen": "127.0.0.1:0",
            "servers": {name: stand_in(arbiter, 5) for name in "ab"},
            "keep_alive_s": 0.05,
            "limits": {"body_max_bytes": "2MiB"},
        }
        started = GatewayProcess(arbiter, config, tmp_path_factory.mktemp("gateway"))
        try:
            yield started
        finally:
            started.close()
    finally:
        arbiter.close()
