"""Steps of the shipped grab with chunks asked for 0, 2 and 5 rows early.

    python tests/bench/bench_prefetch.py [--episodes 40] [--seed 0] [--prefetch 0 2 5]

Real sidecar, real policy on the CPU, no arbiter; each row is one `vram-runner benchmark` over the
same seeds, in which the world waits for late chunks, so that figures do not depend on the machine.
Prints a table and writes `out/bench/prefetch.json`, the summaries of the cells.
"""

import argparse
import json
import subprocess
import sys
import tempfile
import time
from collections.abc import Sequence
from pathlib import Path

import yaml

from tests.support.paths import ROOT

SKILL = "vram-arbiter/so101-grab"
MANIFEST = ROOT / "configs" / "rskills" / "so101-grab" / "rskill.yaml"
BOOT_S = 240.0


def manifest_with(prefetch_at: int, folder: Path) -> Path:
    """Write the shipped skill's manifest with another `prefetch_at`. Return its path."""
    raw = yaml.safe_load(MANIFEST.read_text(encoding="utf-8"))
    raw["policy_extras"]["prefetch_at"] = prefetch_at
    path = folder / f"prefetch-{prefetch_at}" / "rskill.yaml"
    path.parent.mkdir()
    path.write_text(yaml.safe_dump(raw), encoding="utf-8")
    return path


def played(prefetch_at: int, endpoint: str, folder: Path, more: Sequence[str]) -> dict[str, object]:
    """Return the summary of one cell. Raises CalledProcessError."""
    out = folder / f"out-{prefetch_at}"
    subprocess.run(
        [
            sys.executable, "-m", "vram_arbiter.runner", "benchmark", "--skill", SKILL,
            "--skills", str(manifest_with(prefetch_at, folder)), "--sidecar", f"{SKILL}={endpoint}",
            "--no-arbiter", "--no-videos", "--out", str(out), *more,
        ],
        check=True, stdout=subprocess.DEVNULL,
    )  # fmt: skip
    (cell,) = json.loads((out / "benchmark.json").read_text())["cells"]
    return {"prefetch_at": prefetch_at} | {k: v for k, v in cell.items() if k != "episodes"}


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--prefetch", type=int, nargs="+", default=[0, 2, 5])
    parser.add_argument("--out", type=Path, default=Path("out/bench/prefetch.json"))
    options = parser.parse_args()
    more = ["--episodes", str(options.episodes), "--seed", str(options.seed)]
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        socket = folder / "grab.sock"
        sidecar = subprocess.Popen(
            [
                sys.executable, "-m", "vram_arbiter.sidecars", "--name", "grab", "--rskill",
                str(MANIFEST), "--no-arbiter", "--device", "none", "--endpoint", f"ipc://{socket}",
            ]
        )  # fmt: skip
        try:
            boots_until = time.monotonic() + BOOT_S
            while not socket.exists():
                if sidecar.poll() is not None or time.monotonic() > boots_until:
                    raise RuntimeError("the sidecar did not start")
                time.sleep(0.1)
            cells = [played(n, f"ipc://{socket}", folder, more) for n in options.prefetch]
        finally:
            sidecar.terminate()
            sidecar.wait()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(cells, indent=1) + "\n", encoding="utf-8")
    print("| prefetch_at | mean steps | success |\n| --- | --- | --- |")
    for cell in cells:
        print(
            f"| {cell['prefetch_at']} | {cell['mean_steps']:.1f} | "
            f"{cell['successes']}/{cell['judged']} |"
        )
    return 0


if __name__ == "__main__":
    sys.exit(main())
