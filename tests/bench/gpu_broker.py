"""gpu-broker of the registry over stand-in servers, without Docker and without a GPU.

Its docker driver runs the programs `docker` and `nvidia-smi`. Both are a script here that asks this
process, which starts and ends the stand-ins and reads the simulated GPU. All else is as shipped.
"""

import contextlib
import os
import socketserver
import subprocess
import sys
import tempfile
import threading
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from urllib.request import urlopen

import yaml

from tests.support.waiting import until
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.runtime import fakegpu_folder
from vram_arbiter.schemas.runtime.ports import free_port

VERSION = "0.5.0"
TOKEN = "of-the-benchmark-alone"
ASKER = """#!{python} -IS
import socket, sys
asked = socket.socket(socket.AF_UNIX)
asked.connect({path!r})
asked.sendall((" ".join(sys.argv[1:]) + "\\n").encode())
print(asked.makefile().read(), end="")
"""


@dataclass(frozen=True, slots=True)
class Broker:
    """A running gpu-broker. `headers`: what its clients send."""

    url: str
    headers: Mapping[str, str]


class Units:
    """What `docker` and `nvidia-smi` are asked for."""

    def __init__(
        self, commands: Mapping[str, Sequence[str]], environ: Mapping[str, str], gpu: Path
    ) -> None:
        self._commands, self._environ, self._gpu = commands, environ, gpu
        self._running: dict[str, subprocess.Popen[bytes]] = {}

    def answer(self, words: Sequence[str]) -> str:
        name = words[-1]
        match words[0]:
            case "start":
                self._running[name] = subprocess.Popen(self._commands[name], env=self._environ)
                return name
            case "stop":
                self.stop(name)
                return name
            case "inspect":
                running = self._running.get(name)
                return str(running is not None and running.poll() is None).lower()
            case "-L":
                return "GPU 0: simulated"
            case _ if "--query-gpu" in " ".join(words):
                with fakegpu_folder.locked(self._gpu):
                    gpu = fakegpu_folder.settled(self._gpu)
                total = gpu.config.capacity_bytes // MIB
                return f"{gpu.used_bytes // MIB}, {total}, [N/A], [N/A], [N/A], [N/A]"
        return ""

    def stop(self, name: str) -> None:
        if (running := self._running.pop(name, None)) is not None:
            running.terminate()
            running.wait()

    def close(self) -> None:
        for name in list(self._running):
            self.stop(name)


def install(folder: Path) -> Path:
    """Return gpu-broker in a new environment. Raises CalledProcessError without a registry."""
    uv = str(Path(sys.executable).with_name("uv"))
    subprocess.run([uv, "venv", "-q", "--python", sys.executable, str(folder)], check=True)
    python = str(folder / "bin/python")
    wanted = f"gpu-broker=={VERSION}"
    subprocess.run([uv, "pip", "install", "-q", "--python", python, wanted], check=True)
    return folder / "bin/gpu-broker"


@contextlib.contextmanager
def broker(
    program: Path, models: Mapping[str, Sequence[str]], environ: Mapping[str, str], gpu: Path
) -> Iterator[Broker]:
    """Run gpu-broker. `models`: name → [port, command…], as of `plain_proxy`."""
    units = Units({name: words[1:] for name, words in models.items()}, environ, gpu)

    class Handler(socketserver.StreamRequestHandler):
        def handle(self) -> None:
            words = self.rfile.readline().decode().split()
            self.wfile.write(f"{units.answer(words)}\n".encode())

    with tempfile.TemporaryDirectory(prefix="gb") as name:
        folder = Path(name)
        with socketserver.ThreadingUnixStreamServer(f"{folder}/s", Handler) as server:
            thread = threading.Thread(target=server.serve_forever, args=(0.05,))
            thread.start()
            try:
                with _serving(program, models, folder) as url:
                    yield Broker(url, {"Authorization": f"Bearer {TOKEN}"})
            finally:
                units.close()
                server.shutdown()
                thread.join()


@contextlib.contextmanager
def _serving(program: Path, models: Mapping[str, Sequence[str]], folder: Path) -> Iterator[str]:
    for tool in ("docker", "nvidia-smi"):
        (folder / tool).write_text(ASKER.format(python=sys.executable, path=f"{folder}/s"))
        (folder / tool).chmod(0o700)
    entries = {
        name: {
            "kind": "llm",
            "runner": "llm_unit",
            "unit": name,
            "endpoint": f"http://127.0.0.1:{words[0]}",
            "served_name": name,
            "vram_mib": 5120,
            "slots": 32,
            "caps": ["chat"],
            "quality": 50,
            "status": "ready",
        }
        for name, words in models.items()
    }
    defaults = {
        "resident": next(iter(models)),
        "idle_restore_s": 120,
        "session_idle_s": 900,
        "session_yield_s": 120,
        "session_max_s": 14_400,
        "vram_total_mib": 8192,
        "vram_reserve_mib": 600,
    }
    (folder / "catalog.yaml").write_text(yaml.safe_dump({"defaults": defaults, "models": entries}))
    url = f"http://127.0.0.1:{free_port()}"
    config = {
        "catalog": f"{folder}/catalog.yaml",
        "db": f"{folder}/broker.db",
        "events_jsonl": f"{folder}/events.jsonl",
        "server": {"host": "127.0.0.1", "port": int(url.rpartition(":")[2])},
        "comfy": {"url": "http://127.0.0.1:1", "unit": None},
        "driver": {
            "kind": "docker",
            "docker": f"{folder}/docker",
            "nvidia_smi": f"{folder}/nvidia-smi",
            "models_root": f"{folder}/models",
        },
        "inputs": {"staging_dir": f"{folder}/inputs"},
    }
    (folder / "config.yaml").write_text(yaml.safe_dump(config))
    command = [str(program), "-c", f"{folder}/config.yaml", "serve"]
    with (folder / "log").open("wb") as log:
        process = subprocess.Popen(
            command, env={**os.environ, "BROKER_TOKEN": TOKEN}, stdout=log, stderr=log
        )
    try:
        until(lambda: _answers(url) or process.poll() is not None)
        if process.poll() is not None:
            raise RuntimeError(f"gpu-broker ended: {(folder / 'log').read_text()[-2000:]}")
        yield url
    finally:
        process.terminate()
        process.wait()


def _answers(url: str) -> bool:
    try:
        with urlopen(f"{url}/healthz", timeout=1.0):
            return True
    except OSError as error:
        return hasattr(error, "code")  # whatever it says, it serves
