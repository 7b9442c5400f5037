"""`make bench-switch`: how long a model takes to reach the GPU and to leave it.

Real sidecars of three families, each with 500 MB of random weights and more, beside the real daemon
on a simulated GPU, on which a load copies every byte. Writes `out/bench/switch.json`, a list of:

  host            family, or the plain program that it is compared with
  bytes           of the weights
  cold_start_ms   from the start of the program until the model is resident
  load_ms         the same in a running sidecar: the weights are read and copied
  restore_ms      the same for a parked model: the weights are copied
  evict_ms        from the request that needs the room until the model's process is gone
  copy_floor_ms   copying the same bytes in a process forked for it, in turns with the restores:
                  memory of a new process is new, and the kernel clears each page of it first
  copy_again_ms   the second copy onto the same pages, in the same process
  ping_ms         the slowest answer to a `ping` meanwhile, one every 5 ms

Times are medians. The last row of each family loads the same folder by `from_pretrained` in a fresh
process, as a script or a proxy that starts programs would.
"""

import argparse
import json
import mmap
import os
import select
import statistics
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path

from tests.sidecars.adapters.policies import save_act
from tests.sidecars.adapters.tiny_vision import save_owlvit, save_qwen3_5
from tests.support.process import ArbiterProcess
from tests.support.wire import WireClient

PATIENCE_S = 120.0
ROUNDS = 5
NEW_PAGES = mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS | mmap.MAP_POPULATE
RESTORE_MAX = 2.0
"""Target: a restore takes at most so many times the copy of its bytes."""
COLD_MIN = 10.0
"""Target: a cold start takes at least so many times a restore."""
EVICT_MAX_MS = 100.0
PING_MAX_MS = 50.0
PING_EVERY_S = 0.005
COMMON = (
    "version: 0.1.0\nlicense: mit\nembodiment_tags: [any]\nchunk_size: 5\n"
    "description: random weights\nlatency_budget: {per_chunk_ms: 100}\n"
    "quantization: {dtype: fp32}\n"
)


@dataclass(frozen=True, slots=True)
class Family:
    """One host. `save` writes a checkpoint, `plain` is the program without a sidecar."""

    name: str
    save: Callable[[Path], None]
    block: str
    plain: str


@dataclass(slots=True)
class Row:
    """One line of the file; None where a figure has no meaning."""

    host: str
    bytes: int
    cold_start_ms: float
    load_ms: float | None = None
    restore_ms: float | None = None
    evict_ms: float | None = None
    copy_floor_ms: float | None = None
    copy_again_ms: float | None = None
    ping_ms: float | None = None


def _owlvit(folder: Path) -> None:
    save_owlvit(folder, hidden_size=1024, intermediate_size=4096, num_hidden_layers=10)


def _qwen(folder: Path) -> None:
    layers = ["linear_attention", "full_attention"] * 5
    save_qwen3_5(
        folder, hidden_size=1024, intermediate_size=4096, num_hidden_layers=10, layer_types=layers
    )


def _act(folder: Path) -> None:
    save_act(folder, dim_model=1024, n_heads=8, dim_feedforward=4096, n_encoder_layers=8)


FAMILIES = (
    Family(
        "detector", _owlvit,
        "kind: detector\nactions: [detect]\ndetector: {labels: [cube], score_threshold: 0.0}\n",
        "from transformers import AutoModelForZeroShotObjectDetection as C\n"
        "C.from_pretrained(folder)",
    ),
    Family(
        "scene-vlm", _qwen, "kind: vlm\nrole: s2\nactions: [query]\n",
        "from transformers import AutoModelForImageTextToText as C\nC.from_pretrained(folder)",
    ),
    Family(
        "policy", _act,
        "kind: vla\nmodel_family: act\nactions: [grasp]\nactuators_required:\n"
        "  - {kind: joint_position, control_mode_semantics: {mode: absolute}}\n",
        "from lerobot.policies.act.modeling_act import ACTPolicy as C\nC.from_pretrained(folder)",
    ),
)  # fmt: skip


class Host:
    """One sidecar process and what is asked of it."""

    def __init__(self, family: Family, folder: Path, arbiter: ArbiterProcess, count: int) -> None:
        self._arbiter = arbiter
        self._command = [
            sys.executable, "-m", "vram_arbiter.sidecars", "--name", family.name,
            "--rskill", str(folder / "rskill.yaml"), "--configs", str(folder),
            "--footprint", f"{count},{count},0", "--device", f"fake:{arbiter.gpu_folder}",
            "--min-residency-s", "0", "--nice", "0", "--log-level", "warning",
        ]  # fmt: skip
        self._endpoint = f"ipc://{arbiter.runtime}/{family.name}.sock"
        self._process = subprocess.Popen(self._command, env=arbiter.environ)
        self.client = WireClient(self._endpoint)

    def load_ms(self) -> float:
        began = time.perf_counter()
        reply = self.client.reply(self.client.send("load"), PATIENCE_S)
        assert reply["ok"], reply
        assert reply["loaded"], "it was resident already"
        return (time.perf_counter() - began) * 1e3

    def unload(self) -> None:
        """Free the weights, also those in host RAM, and wait until the arbiter measured it."""
        self.client.reply(self.client.send("unload"), PATIENCE_S)
        with WireClient(self._arbiter.endpoint) as looking:
            looking.hello("looking", role="observer")
            while looking.ask("status")["leases"]:
                time.sleep(0.01)

    def evict_ms(self, other: WireClient) -> float:
        """Have another holder take the whole GPU; it leaves again at once."""
        model = os.pidfd_open(_only_child(_only_child(self._server())))
        try:
            began = time.perf_counter()
            request = other.send(
                "acquire",
                nonce=f"{began}",
                spec={"consumer": "other", "model_id": "other", "ttl_s": PATIENCE_S,
                      "mode": "exclusive", "footprint": {"load_peak_bytes": 1 << 30,
                      "steady_bytes": 1 << 30, "residue_bytes": 0}},
            )  # fmt: skip
            gone, _, _ = select.select([model], [], [], PATIENCE_S)
            took_ms = (time.perf_counter() - began) * 1e3
        finally:
            os.close(model)
        assert gone, "the model's process did not end"
        reply = other.reply(request, PATIENCE_S)
        assert reply["ok"], reply
        lease = reply["lease"]
        if lease["state"] != "loading":
            lease = other.push("granted", PATIENCE_S)["lease"]
        assert self.client.ask("ping")["state"] == "parked"
        released = other.ask("release", lease_id=lease["lease_id"], token=lease["token"])
        assert released["ok"], released
        return took_ms

    @contextmanager
    def pinged(self) -> Iterator[list[float]]:
        """Ask for its state over a connection of its own; yields the milliseconds it took."""
        took_ms: list[float] = []
        over = threading.Event()

        def ask() -> None:
            with WireClient(self._endpoint) as client:
                while not over.wait(PING_EVERY_S):
                    began = time.perf_counter()
                    client.ask("ping")
                    took_ms.append((time.perf_counter() - began) * 1e3)

        asking = threading.Thread(target=ask)
        asking.start()
        try:
            yield took_ms
        finally:
            over.set()
            asking.join()

    def _server(self) -> int:
        """Pid of the server of imports, among the children of the host."""
        for pid in _children(self._process.pid):
            if "forkserver" in Path(f"/proc/{pid}/cmdline").read_text():
                return pid
        raise AssertionError("no server of imports")

    def close(self) -> None:
        self.client.close()
        self._process.terminate()
        self._process.wait(PATIENCE_S)


def measure(family: Family, rounds: int) -> Iterator[Row]:
    """Yield the row of a family, and that of its plain program."""
    with tempfile.TemporaryDirectory(prefix="vs") as name:
        folder = Path(name)
        checkpoint = folder / "models" / family.name
        checkpoint.mkdir(parents=True)
        family.save(checkpoint)
        (folder / "rskill.yaml").write_text(
            f"name: bench/{family.name}\nweights_uri: local://models/{family.name}\n"
            f"{COMMON}{family.block}"
        )
        count = (checkpoint / "model.safetensors").stat().st_size
        memory = mmap.mmap(-1, count)  # shared
        (checkpoint / "model.safetensors").open("rb").readinto(memory)

        with _arbiter() as arbiter:
            began = time.perf_counter()
            host = Host(family, folder, arbiter, count)
            try:
                host.load_ms()
                cold_ms = (time.perf_counter() - began) * 1e3
                loads, restores, evicts, copies = [], [], [], []
                for _ in range(rounds):
                    host.unload()
                    loads.append(host.load_ms())
                with WireClient(arbiter.endpoint) as other, host.pinged() as pings:
                    other.hello("other")
                    for _ in range(rounds):
                        evicts.append(host.evict_ms(other))
                        copies.append(copies_ms(memory))
                        restores.append(host.load_ms())
            finally:
                host.close()
        middle = statistics.median
        floors, again = zip(*copies, strict=True)
        yield Row(
            family.name, count, cold_ms, middle(loads), middle(restores), middle(evicts),
            middle(floors), middle(again), max(pings),
        )  # fmt: skip
        program = f"folder = {str(checkpoint)!r}\n{family.plain}"
        took = []
        for _ in range(min(rounds, 3)):
            began = time.perf_counter()
            subprocess.run([sys.executable, "-c", program], check=True, capture_output=True)
            took.append((time.perf_counter() - began) * 1e3)
        yield Row(f"{family.name}: from_pretrained in a fresh process", count, middle(took))


def copies_ms(memory: mmap.mmap) -> tuple[float, float]:
    """Return the milliseconds of two copies of shared memory onto the same pages of a new process,
    in one piece and of pages that are asked for at once: the fastest way found."""
    ours, theirs = os.pipe()
    pid = os.fork()
    if pid == 0:
        began = time.perf_counter()
        copy = mmap.mmap(-1, len(memory), flags=NEW_PAGES)
        copy[:] = memory
        between = time.perf_counter()
        copy[:] = memory
        took = between - began, time.perf_counter() - between
        os.write(theirs, json.dumps([one * 1e3 for one in took]).encode())
        os._exit(0)
    os.close(theirs)
    with open(ours) as told:
        once, again = json.load(told)
    os.waitpid(pid, 0)
    return once, again


@contextmanager
def _arbiter() -> Iterator[ArbiterProcess]:
    arbiter = ArbiterProcess("fake:8GiB")
    try:
        yield arbiter.start()
    finally:
        arbiter.close()


def _children(pid: int) -> list[int]:
    return [int(one) for one in Path(f"/proc/{pid}/task/{pid}/children").read_text().split()]


def _only_child(pid: int) -> int:
    (child,) = _children(pid)
    return child


def switch_table(rows: list[Row]) -> str:
    """Return the rows with their targets, for people."""
    lines = []
    for row in rows:
        figures = {key: value for key, value in asdict(row).items() if key.endswith("_ms")}
        told = "  ".join(f"{key} {value:.0f}" for key, value in figures.items() if value)
        lines.append(f"{row.host} ({row.bytes / 1e6:.0f} MB): {told}")
        if row.restore_ms and row.copy_floor_ms and row.evict_ms and row.ping_ms:
            ratio, cold = row.restore_ms / row.copy_floor_ms, row.cold_start_ms / row.restore_ms
            lines.append(
                f"  restore {ratio:.2f} x the copy {_met(ratio <= RESTORE_MAX)}; "
                f"cold start {cold:.0f} x a restore {_met(cold >= COLD_MIN)}; "
                f"eviction {_met(row.evict_ms <= EVICT_MAX_MS)}; "
                f"ping {_met(row.ping_ms <= PING_MAX_MS)}"
            )
    return "\n".join(lines)


def _met(ok: bool) -> str:
    return "(met)" if ok else "(MISSED)"


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--quick", action="store_true", help="one round of each")
    parser.add_argument("--only", action="append", choices=[one.name for one in FAMILIES])
    parser.add_argument("--out", type=Path, default=Path("out/bench/switch.json"))
    options = parser.parse_args()
    rows: list[Row] = []
    for family in FAMILIES:
        if not options.only or family.name in options.only:
            rows += measure(family, 1 if options.quick else ROUNDS)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps([asdict(row) for row in rows], indent=1) + "\n")
    print(f"{switch_table(rows)}\nrows are in {options.out}")
    return 0


if __name__ == "__main__":
    sys.exit(main())
