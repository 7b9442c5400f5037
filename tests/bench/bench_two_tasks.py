"""Two tasks in one world: the demo's programs grab the seed's target, then another object.

    python -m tests.bench.bench_two_tasks [--episodes 10] [--seed 0]

All programs of `vramctl demo` on a simulated GPU of 8 GiB, one world after another. A task counts
when the reasoner reports success and the simulator's truth says that the named object is held.
Writes one JSON line a seed to `out/bench/two-tasks.jsonl`; seeds that are there already, of the
same commit, are not played again. It takes two minutes a seed on two quiet cores.
"""

import argparse
import asyncio
import contextlib
import json
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TypedDict

from tests.support.paths import ROOT
from vram_arbiter.clients.cli.demo import BUDGET, LOOP_S, Episode, boot, make_gpu
from vram_arbiter.clients.cli.programs import Programs
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.schemas.runtime.endpoints import RUNTIME_VARIABLE
from vram_arbiter.schemas.units import parse_bytes

TASKS = 2


class Task(TypedDict):
    """One task of a world. `held` is what the simulator says is held at its end."""

    task: str
    status: str
    reason: str
    attempts: int
    held: str | None
    done: bool


async def play_world(seed: int, out: Path) -> list[Task]:
    """Boot the programs, run the tasks, end the programs. Logs stay below `out`."""
    shutil.rmtree(out, ignore_errors=True)
    (out / "logs").mkdir(parents=True)
    with tempfile.TemporaryDirectory(prefix="vram-two-") as name:
        runtime = Path(name)
        environ = {RUNTIME_VARIABLE: name, "HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
        programs = Programs(out / "logs", environ)
        try:
            make_gpu(runtime / "fakegpu", parse_bytes(BUDGET))
            async with contextlib.AsyncExitStack() as stack:
                runner = await stack.enter_async_context(
                    RunnerClient(f"ipc://{runtime}/runner.sock")
                )
                what = Episode(seed, True, f"fake:{BUDGET}", out)
                await boot(programs, runtime, runner, stack, what)
                truth = await runner.ground_truth()
                others = [one for one in truth["objects"] if one != truth["target"]]
                played: list[Task] = []
                for number, target in enumerate([truth["target"], *others[: TASKS - 1]]):
                    result = out / f"reasoner-{number}.json"
                    reasoner = await programs.start(
                        f"reasoner-{number}", "reasoner", "--task", f"grab the {target}",
                        "--result", str(result.resolve()),
                    )  # fmt: skip
                    with contextlib.suppress(TimeoutError):
                        async with asyncio.timeout(LOOP_S):
                            await reasoner.process.wait()
                    await programs.stop(reasoner.name)
                    said = json.loads(result.read_text()) if result.exists() else {}
                    held = (await runner.ground_truth())["held"]
                    status = said.get("status", "no result")
                    played.append(
                        {
                            "task": f"grab the {target}",
                            "status": status,
                            "reason": said.get("reason", reasoner.tail()),
                            "attempts": said.get("attempts", 0),
                            "held": held,
                            "done": status == "success" and held == target,
                        }
                    )
            return played
        finally:
            await programs.stop_all()


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").splitlines()[0])
    parser.add_argument("--episodes", type=int, default=10)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/bench/two-tasks.jsonl"))
    options = parser.parse_args()
    commit = subprocess.check_output(
        ["git", "describe", "--always", "--dirty"], cwd=ROOT, text=True
    ).strip()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    lines = options.out.read_text(encoding="utf-8").splitlines() if options.out.exists() else []
    known = {one["seed"]: one for one in map(json.loads, lines) if one["commit"] == commit}
    for seed in range(options.seed, options.seed + options.episodes):
        if seed not in known:
            began = time.monotonic()
            tasks = asyncio.run(play_world(seed, options.out.with_suffix("") / str(seed)))
            known[seed] = {
                "seed": seed, "commit": commit, "done": all(one["done"] for one in tasks),
                "seconds": round(time.monotonic() - began), "tasks": tasks,
            }  # fmt: skip
            with options.out.open("a", encoding="utf-8") as sink:
                sink.write(json.dumps(known[seed]) + "\n")
        print(json.dumps(known[seed]), flush=True)
    done = sum(bool(one["done"]) for one in known.values())
    print(f"commit {commit}: both tasks done in {done} of {len(known)} worlds")
    return 0


if __name__ == "__main__":
    sys.exit(main())
