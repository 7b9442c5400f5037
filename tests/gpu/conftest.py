"""The same tests on a simulated GPU, everywhere, and on an NVIDIA GPU, where there is one
(`make test-gpu`)."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, field
from functools import cache
from pathlib import Path
from typing import Any

import pytest

from tests.gpu import weights_model
from tests.support.process import ArbiterProcess
from tests.support.processes import children, server_of_imports
from tests.support.waiting import until
from tests.support.wire import WireClient
from vram_arbiter.clients.calibration.gpu import Gpu, open_gpu
from vram_arbiter.schemas.errors import VramError

MIB, GIB = 2**20, 2**30
PATIENCE_S = 120.0
"""Imports, a context and a copy of 512 MiB, on a busy machine."""
TOLERANCE_BYTES = 64 * MIB
UVM = "/dev/nvidia-uvm"
"""Device file of CUDA's unified memory: `cuInit` opens it, and reading by NVML does not."""
MANIFEST = """
name: test/{name}
version: 0.1.0
license: apache-2.0
kind: detector
embodiment_tags: [any]
chunk_size: 1
weights_uri: hf://test/{name}
description: random weights
latency_budget: {{per_chunk_ms: 100}}
actions: [detect]
detector: {{labels: [cube]}}
quantization: {quantization}
"""
NF4 = "{dtype: int4, extra: {compute_dtype: float32, min_params_to_quantize: 0, skip_modules: []}}"


@cache
def without_cuda() -> str | None:
    """Return why no CUDA program can run here; None: one can."""
    try:
        open_gpu("cuda")
    except VramError as error:
        return error.message
    os.environ.setdefault("PYTORCH_NVML_BASED_CUDA_CHECK", "1")  # no context in this process
    import torch

    if torch.version.cuda is None:
        return f"torch {torch.__version__} is built without CUDA"
    if not torch.cuda.is_available():
        return "torch sees no GPU"
    return None


@dataclass
class Model:
    """A sidecar around random weights."""

    process: "subprocess.Popen[bytes]"
    client: WireClient
    log: Path

    def send(self, op: str, **fields: Any) -> int:
        return self.client.send(op, **fields)

    def result(self, request: int) -> dict[str, Any]:
        answer = self.client.reply(request, PATIENCE_S)
        assert answer["ok"], (answer, self.log.read_text())
        return answer

    def send_detect(self, query: str = "cube") -> int:
        return self.send("detect", image=b"\x89PNG\r\n\x1a\n", query=query)

    def detect(self, query: str = "cube") -> str:
        answer: str = self.result(self.send_detect(query))["answer"]
        return answer

    def state(self) -> str:
        found: str = self.result(self.send("ping"))["state"]
        return found

    @property
    def forks(self) -> tuple[int, int]:
        """Pids of the server of imports and of the keeper of the weights."""
        server = server_of_imports(self.process.pid)
        (keeper,) = children(server)
        return server, keeper

    @property
    def pid(self) -> int | None:
        """Pid of the process that has the model on the GPU; None: there is none."""
        return next(iter(children(self.forks[1])), None)


@dataclass
class Machine:
    """A GPU under a running arbiter."""

    kind: str
    arbiter: ArbiterProcess
    gpu: Gpu
    weights_bytes: int
    models: list[Model] = field(default_factory=list)

    @property
    def environ(self) -> dict[str, str]:
        return {**self.arbiter.environ, **self.gpu.environ}

    def start(self, name: str, *flags: str, quantization: str = "{dtype: fp32}") -> Model:
        folder = self.arbiter.runtime / f"{name}-model"
        folder.mkdir()
        manifest = MANIFEST.format(name=name, quantization=quantization)
        (folder / "rskill.yaml").write_text(manifest)
        program = [str(weights_model.__file__), str(self.weights_bytes)]
        return self.serve(name, program, folder / "rskill.yaml", *flags)

    def serve(self, name: str, program: Sequence[str], rskill: Path, *flags: str) -> Model:
        """Start a sidecar by the arguments of Python that begin its program."""
        argv = [
            sys.executable, *program, "--name", name, "--rskill", str(rskill),
            "--device", self.gpu.device, "--gpu", self.gpu.uuid, *flags,
        ]  # fmt: skip
        path = self.arbiter.runtime / f"{name}.log"
        with path.open("ab") as log:
            process = subprocess.Popen(argv, env=self.environ, stdout=log, stderr=log)
        client = WireClient(f"ipc://{self.arbiter.runtime}/{name}.sock")
        self.models.append(Model(process, client, path))
        assert self.models[-1].state() == "unloaded"
        return self.models[-1]

    def used(self) -> int:
        return self.gpu.read().used_bytes

    def bytes_of(self, pid: int) -> int:
        """Return the bytes of a process. Skips the test where the driver lists none."""
        processes = self.gpu.read().processes
        if processes is None:
            pytest.skip("the driver does not list bytes by process here (a container?)")
        return processes.get(pid, 0)

    def has_context(self, pid: int) -> bool:
        if self.kind == "fake":
            return self.bytes_of(pid) > 0
        opened = []
        for one in Path(f"/proc/{pid}/fd").iterdir():
            try:
                opened.append(os.readlink(one))
            except FileNotFoundError:  # closed meanwhile
                continue
        return UVM in opened or self.bytes_of(pid) > 0

    def status(self) -> dict[str, Any]:
        with WireClient(self.arbiter.endpoint) as client:
            return client.hello().ask("status")

    def lease_state(self, consumer: str) -> str | None:
        """Return the state of a consumer's lease; None: it has none."""
        leases = self.status()["leases"]
        return next((one["state"] for one in leases if one["consumer"] == consumer), None)

    def budget(self) -> int:
        """Return the bytes that the arbiter leases on the GPU."""
        (view,) = [view for view in self.status()["gpus"] if view["gpu"] == self.gpu.uuid]
        return int(view["capacity_bytes"] - view["reserve_bytes"] - view["stowaway_bytes"])

    def close(self) -> None:
        for model in self.models:
            model.client.close()
            model.process.terminate()
        for model in self.models:
            try:
                model.process.wait(PATIENCE_S)
            except subprocess.TimeoutExpired:
                model.process.kill()
                model.process.wait(PATIENCE_S)


@pytest.fixture(params=["fake", pytest.param("cuda", marks=pytest.mark.gpu)])
def kind(request: pytest.FixtureRequest) -> str:
    """`fake` or `cuda`; the latter skips where no CUDA program can run."""
    found: str = request.param
    if found == "cuda" and (why := without_cuda()):
        pytest.skip(f"needs an NVIDIA GPU: {why}")
    return found


@pytest.fixture
def machine(kind: str, make_arbiter: Callable[..., ArbiterProcess]) -> Iterator[Machine]:
    made = machine_of(kind, make_arbiter)
    yield made
    made.close()


@pytest.fixture
def small_machine(kind: str, make_arbiter: Callable[..., ArbiterProcess]) -> Iterator[Machine]:
    """8 GiB are leased of a GPU of any size."""
    made = machine_of(kind, make_arbiter, config='gpu: {capacity_bytes: {"0": 8GiB}}')
    yield made
    made.close()


def machine_of(kind: str, make_arbiter: Callable[..., ArbiterProcess], **options: Any) -> Machine:
    if kind == "fake":
        arbiter = make_arbiter(**options).start()
        return Machine(kind, arbiter, open_gpu(f"fake:{arbiter.gpu_folder}"), 32 * MIB)
    arbiter = make_arbiter(gpu="nvml", **options).start()
    return Machine(kind, arbiter, open_gpu("cuda"), 512 * MIB)


def back(machine: Machine, used_bytes: int) -> bool:
    """Wait until the GPU's used bytes are back where they were."""
    return until(lambda: machine.used() <= used_bytes + TOLERANCE_BYTES)
