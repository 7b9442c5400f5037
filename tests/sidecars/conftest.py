"""Real sidecar processes around a model without weights, beside the real daemon."""

import os
import shutil
import tempfile
from pathlib import Path

import pytest

from tests.support.fakegpu_check import check_log
from tests.support.prepared import start
from tests.support.processes import children, server_of_imports
from tests.support.waiting import PATIENCE_S, until
from tests.support.wire import WireClient
from vram_arbiter.arbiter.host.gpu.fake import FakeProbe, make_gpu

PNG = b"\x89PNG\r\n\x1a\n"  # the echo does not look at it
MANIFEST = """
name: test/{name}
version: 0.1.0
license: mit
kind: detector
embodiment_tags: [any]
chunk_size: 1
weights_uri: hf://test/{name}
description: an echo
latency_budget: {{per_chunk_ms: 100}}
actions: [detect]
detector: {{labels: [cube]}}
"""


class Sidecar:
    """One process. `ask` speaks the wire; `folder` tells the model what to do."""

    def __init__(self, process, endpoint, folder):
        self.process = process
        self.folder = folder
        self.endpoint = endpoint
        self.client = WireClient(endpoint)

    def ask(self, op, **fields):
        return self.client.reply(self.client.send(op, **fields), PATIENCE_S)

    def send_detect(self, query="red cube", **fields):
        return self.client.send("detect", image=PNG, query=query, **fields)

    def detect(self, query="red cube", **fields):
        return self.client.reply(self.send_detect(query, **fields), PATIENCE_S)

    def state(self):
        return self.ask("ping")["state"]

    def hold(self):
        """Start an op that runs until `let_go`; returns its id once the model is in it."""
        request = self.send_detect("hold go")
        until(lambda: (self.folder / "holding").exists())
        return request

    def let_go(self):
        (self.folder / "go").touch()

    def terminate(self):
        self.process.terminate()
        return self.process.wait(PATIENCE_S)

    def model_pid(self):
        """Pid of the model's process: forked from the keeper of the weights, which was forked from
        the server of imports."""
        (keeper,) = children(server_of_imports(self.process.pid))
        (model,) = children(keeper)
        return model

    @property
    def log(self):
        return (self.folder / "log").read_text()


class Box:
    """A runtime folder with a GPU; `start` starts sidecars in it."""

    def __init__(self, runtime, gpu_folder, environ):
        self.runtime = runtime
        self.gpu_folder = gpu_folder
        self.environ = environ
        self.sidecars = []

    def spawn(self, name, *flags, footprint="1GB,1GB,100MB", device=None, start=start):
        """`start`: by default a program whose imports are made already."""
        folder = self.runtime / f"{name}-model"
        folder.mkdir(exist_ok=True)
        (folder / "rskill.yaml").write_text(MANIFEST.format(name=name))
        arguments = [
            str(folder), "--name", name, "--rskill", str(folder / "rskill.yaml"),
            "--device", device or f"fake:{self.gpu_folder}", "--footprint", footprint, *flags,
        ]  # fmt: skip
        with (folder / "log").open("ab") as log:
            process = start("echo", arguments, self.environ, log.fileno(), log.fileno())
        sidecar = Sidecar(process, f"ipc://{self.runtime}/{name}.sock", folder)
        self.sidecars.append(sidecar)
        return sidecar

    def start(self, name, *flags, **options):
        sidecar = self.spawn(name, *flags, **options)
        assert sidecar.ask("ping")["ok"]
        return sidecar

    def used(self):
        probe = FakeProbe([self.gpu_folder])
        return probe.sample(probe.gpus()[0].id).used_bytes

    def close(self):
        for sidecar in self.sidecars:
            sidecar.client.close()
            if sidecar.process.poll() is None:
                sidecar.process.kill()
                sidecar.process.wait(PATIENCE_S)
        report = (
            check_log((self.gpu_folder / "log.jsonl").read_text())
            if (self.gpu_folder / "log.jsonl").exists()
            else None
        )
        assert report is None or report.problems == [], report


@pytest.fixture
def box(arbiter_daemon):
    """Sidecars beside a real daemon."""
    box = Box(arbiter_daemon.runtime, arbiter_daemon.gpu_folder, arbiter_daemon.environ)
    yield box
    box.close()


@pytest.fixture
def arbiter(arbiter_daemon):
    """An operator's connection: the status that it gets shows tokens."""
    with WireClient(arbiter_daemon.endpoint) as client:
        yield client.hello("looker", role="operator")


@pytest.fixture
def lone_box():
    """Sidecars without an arbiter."""
    runtime = Path(tempfile.mkdtemp(prefix="vs"))
    make_gpu(runtime / "fakegpu", 8 * 2**30, release_lag_s=0.1)
    root = str(Path(__file__).parents[2])
    box = Box(
        runtime,
        runtime / "fakegpu",
        {**os.environ, "VRAM_ARBITER_RUNTIME": str(runtime), "PYTHONPATH": f"{root}/src:{root}"},
    )
    yield box
    try:
        box.close()
    finally:
        shutil.rmtree(runtime, ignore_errors=True)
