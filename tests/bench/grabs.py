"""The shipped grab for benches: its real sidecar, and the runner's benchmark in this process."""

import argparse
import contextlib
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from pathlib import Path

from tests.support.paths import ROOT
from vram_arbiter.runner.cli.benchmark import add_parser

SKILL = "vram-arbiter/so101-grab"
MANIFEST = ROOT / "configs" / "rskills" / "so101-grab" / "rskill.yaml"
BOOT_S = 240.0


@contextlib.contextmanager
def grab_sidecar() -> Iterator[str]:
    """Run the sidecar without arbiter, on the CPU; yield its endpoint."""
    with tempfile.TemporaryDirectory() as name:
        socket = Path(name) / "grab.sock"
        process = subprocess.Popen(
            [
                sys.executable, "-m", "vram_arbiter.sidecars", "--name", "grab", "--rskill",
                str(MANIFEST), "--no-arbiter", "--device", "none", "--endpoint", f"ipc://{socket}",
            ],
            stderr=subprocess.DEVNULL,
        )  # fmt: skip
        try:
            boots_until = time.monotonic() + BOOT_S
            while not socket.exists():
                if process.poll() is not None or time.monotonic() > boots_until:
                    raise RuntimeError("the sidecar did not start")
                time.sleep(0.1)
            yield f"ipc://{socket}"
        finally:
            process.terminate()
            process.wait()


def benchmark_arguments(endpoint: str, manifest: Path, *more: str) -> argparse.Namespace:
    """Return the arguments of `vram-runner benchmark` for the grab of this manifest."""
    parser = argparse.ArgumentParser()
    add_parser(parser.add_subparsers())
    return parser.parse_args(
        [
            "benchmark", "--skill", SKILL, "--skills", str(manifest), "--no-arbiter", "--no-videos",
            "--sidecar", f"{SKILL}={endpoint}", *more,
        ]
    )  # fmt: skip
