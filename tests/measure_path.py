"""Length of the path of one acquire with one eviction: `PYTHONPATH=. python tests/measure_path.py`.

A real daemon, a holder and a waiter, each a process of its own on a simulated GPU that returns
memory at once. Counted in the main thread of each, from the call of `acquire` to the grant: the
product's functions that run, their files, and how often the next function to run lies in another
file than the last one. Libraries, tests, and the threads that read the GPU and write the history
are left out; so is what a program does before and after. `--list` prints the path itself.
"""

import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any

from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from vram_arbiter.arbiter.host.gpu.fake import make_card

GIB = 1 << 30
PATIENCE_S = 60.0
PACKAGES = ("arbiter", "clients", "schemas")
TARGETS = {"files": 30, "functions": 150, "switches": 300, "core modules": 12, "core functions": 80}


type Step = tuple[str, str, int]
"""File, function, line."""


class Tracer:
    """Product functions that the main thread begins or resumes, in their order."""

    def __init__(self, out: Path) -> None:
        self._out = out
        self._steps: list[CodeType] = []
        self._thread = threading.get_ident()
        monitoring = sys.monitoring
        monitoring.use_tool_id(monitoring.PROFILER_ID, "path")
        for event in (monitoring.events.PY_START, monitoring.events.PY_RESUME):
            monitoring.register_callback(monitoring.PROFILER_ID, event, self._step)

    def start(self, *_: object) -> None:
        events = sys.monitoring.events
        sys.monitoring.set_events(sys.monitoring.PROFILER_ID, events.PY_START | events.PY_RESUME)
        self._out.with_suffix(".started").touch()

    def stop(self, *_: object) -> None:
        """Write what ran since `start` as a list of `[file, function, line]`."""
        sys.monitoring.set_events(sys.monitoring.PROFILER_ID, 0)
        known = {code: _product_file(code.co_filename) for code in set(self._steps)}
        told = [
            (known[code], code.co_qualname, code.co_firstlineno)
            for code in self._steps
            if known[code] is not None
        ]
        written = self._out.with_suffix(".part")
        written.write_text(json.dumps(told))
        written.rename(self._out)

    def _step(self, code: CodeType, _offset: int) -> None:
        if threading.get_ident() == self._thread:
            self._steps.append(code)


def _product_file(name: str) -> str | None:
    path = Path(name).resolve()
    if path == Path(__file__).resolve() or not path.is_relative_to(ROOT):
        return None
    file = str(path.relative_to(ROOT))
    return file if file.split("/")[0] in PACKAGES else None


# -- the three programs
def daemon(tracer: Tracer, arguments: list[str]) -> None:
    """The daemon itself; the measuring process turns its tracer on and off by signals."""
    from vram_arbiter.arbiter.__main__ import main

    signal.signal(signal.SIGUSR1, tracer.start)
    signal.signal(signal.SIGUSR2, tracer.stop)
    raise SystemExit(main(arguments))


async def holder(tracer: Tracer) -> None:
    """Hold the GPU with an idle lease, and free it when the arbiter asks."""
    from vram_arbiter.clients.client import AsyncClient
    from vram_arbiter.sidecars.device.fake import FakeMemory

    memory = FakeMemory(Path(os.environ["VRAM_ARBITER_RUNTIME"]) / "fakegpu", "holder")

    def free() -> None:
        memory.free(block)
        memory.empty_cache()

    async def unload() -> None:
        await asyncio.to_thread(free)

    async with AsyncClient(name="holder") as client:
        lease = await client.acquire(_spec("holder"), unload=unload)
        memory.bind(lease.gpu)
        block = memory.allocate("weights", 5 * GIB)
        await lease.ready(5 * GIB)
        tracer.start()
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        tracer.stop()
    memory.close()


async def waiter(tracer: Tracer) -> None:
    """Ask for the holder's place, and get it."""
    from vram_arbiter.clients.client import AsyncClient

    async with AsyncClient(name="waiter") as client:
        spec = _spec("waiter")
        print("ready", flush=True)
        await asyncio.to_thread(sys.stdin.readline)
        tracer.start()
        await client.acquire(spec)
        tracer.stop()
        print("granted", flush=True)


def _spec(consumer: str) -> Any:
    from vram_arbiter.schemas.wire.requests import Footprint, LeaseSpec

    size = Footprint(load_peak_bytes=5 * GIB, steady_bytes=5 * GIB, residue_bytes=450 << 20)
    # a TTL without renewals in the measured time, and no minimum residency to wait for
    return LeaseSpec(
        consumer=consumer, model_id=consumer, footprint=size, ttl_s=600.0, min_residency_s=0.0
    )


# -- measuring
def record(folder: Path) -> dict[str, list[Step]]:
    """Run the scene once. Returns the steps of each side."""
    arbiter = ArbiterProcess()
    make_card(arbiter.card, 8 * GIB, release_lag_s=0.0)
    out = {side: folder / f"{side}.json" for side in ("daemon", "holder", "waiter")}
    arbiter.program = [sys.executable, str(Path(__file__)), "daemon", str(out["daemon"])]
    programs: list[subprocess.Popen[str]] = []

    def start(side: str) -> subprocess.Popen[str]:
        command = [sys.executable, str(Path(__file__)), side, str(out[side])]
        programs.append(
            subprocess.Popen(
                command,
                env=arbiter.environ,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        )
        _heard(programs[-1], "ready")
        return programs[-1]

    try:
        arbiter.start()
        held, waits = start("holder"), start("waiter")
        os.kill(arbiter.pid, signal.SIGUSR1)
        _until(out["daemon"].with_suffix(".started").exists)
        _tell(waits)
        _heard(waits, "granted")
        os.kill(arbiter.pid, signal.SIGUSR2)
        _tell(held)
        for path in out.values():
            _until(path.exists)
        return {
            side: [(file, name, line) for file, name, line in json.loads(path.read_text())]
            for side, path in out.items()
        }
    finally:
        for program in programs:
            if program.poll() is None:
                program.kill()
            program.communicate()
        arbiter.close()


def _tell(program: "subprocess.Popen[str]") -> None:
    assert program.stdin is not None
    program.stdin.write("\n")
    program.stdin.flush()


def _heard(program: "subprocess.Popen[str]", word: str) -> None:
    assert program.stdout is not None
    line = program.stdout.readline().strip()
    if line != word:
        raise RuntimeError(f"expected {word!r} from {program.args}, got {line!r}")


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"not within {PATIENCE_S:g} s: {condition}")
        time.sleep(0.01)


def figures(steps: Mapping[str, list[Step]]) -> dict[str, dict[str, int]]:
    """Files, functions and switches of each side and of the path: the waiter's and the daemon's.

    Of the path also the modules and functions of the core.
    """
    told = {side: _counted(side_steps) for side, side_steps in steps.items()}
    path = [*steps["waiter"], *steps["daemon"]]
    told["path"] = _counted(path)
    core = _counted([step for step in path if step[0].startswith("arbiter/core/")])
    told["path"] |= {"core modules": core["files"], "core functions": core["functions"]}
    return told


def _counted(path: list[Step]) -> dict[str, int]:
    switches = sum(before[0] != after[0] for before, after in pairwise(path))
    files = {file for file, _, _ in path}
    return {"files": len(files), "functions": len(set(path)), "switches": switches}


def main() -> int:
    with tempfile.TemporaryDirectory(prefix="path") as folder:
        steps = record(Path(folder))
    told = figures(steps)
    if "--list" in sys.argv:
        for side, path in steps.items():
            seen = dict.fromkeys(f"{file}:{line} {name}" for file, name, line in path)
            print(f"{side}:", *seen, sep="\n  ")
    for side, counts in told.items():
        print(f"{side:8}" + "".join(f" {name} {count}  " for name, count in counts.items()))
    print("targets: " + ", ".join(f"{name} {most}" for name, most in TARGETS.items()))
    return 0


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["daemon", out, *rest]:
            daemon(Tracer(Path(out)), rest)
        case ["holder", out]:
            asyncio.run(holder(Tracer(Path(out))))
        case ["waiter", out]:
            asyncio.run(waiter(Tracer(Path(out))))
        case _:
            raise SystemExit(main())
