"""Length of the path of one acquire with one eviction: `python tests/measure_path.py`.

A real daemon, a holder and a waiter, each a process of its own on a simulated GPU that returns
memory at once. Counted in the main thread of each, from the call of `acquire` to the grant: the
product's functions that run, their files, and how often the next function to run lies in another
file than the last one. Libraries, tests, and the threads that read the GPU and write the history
are left out; so is what a program does before and after. The daemon's side ends when its loop has
done the event of the grant: it reads the GPU for the new load before the counting is turned off.

The path is warm: the scene plays once before it is counted, so that imports, encoders made on
demand and filled caches are not part of it. Of five such runs the shortest counts: readings by
the clock fall into some of them. A generator expression or a lambda is a line of its
function, not a function; a switch into its file counts.

Options:
    --list   print the path itself: each function once, in the order of its first call
    --files  print functions and entries per file; an entry is a switch into the file
    --cold   count the first scene, and generator expressions and lambdas as functions
"""

import argparse
import asyncio
import json
import os
import signal
import subprocess
import sys
import tempfile
import threading
import time
from collections import Counter
from collections.abc import AsyncIterator, Callable, Mapping
from itertools import pairwise
from pathlib import Path
from types import CodeType
from typing import Any

# Some wheel installs a package `tests` of its own, and an environment may hold another tree.
sys.path.insert(0, str(Path(__file__).parents[1]))
sys.path.insert(0, str(Path(__file__).parents[1] / "src"))

from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from vram_arbiter.arbiter.host.gpu.fake import make_gpu

GIB = 1 << 30
PATIENCE_S = 60.0
RUNS = 5
PACKAGES = ("arbiter", "clients", "schemas")
TARGETS = {"files": 42, "functions": 220, "switches": 450, "core modules": 12, "core lines": 3300}


GRANT = ("arbiter/core/scheduling/grants.py", "grant")
LOOP = ("arbiter/host/process.py", "FineSelector.select")
"""The daemon's event loop asks for what is ready: what it was told before is done."""

LINES = ("<genexpr>", "<lambda>")
"""Code objects that are lines of their function."""

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
def run_daemon(tracer: Tracer, arguments: list[str]) -> None:
    """The daemon itself; the measuring process turns its tracer on and off by signals."""
    from vram_arbiter.arbiter.__main__ import main

    signal.signal(signal.SIGUSR1, tracer.start)
    signal.signal(signal.SIGUSR2, tracer.stop)
    raise SystemExit(main(arguments))


async def holder(tracer: Tracer) -> None:
    """Hold the GPU with an idle lease; free it when the arbiter asks: `hold`, `trace`, `write`."""
    from vram_arbiter.clients.client import AsyncClient
    from vram_arbiter.sidecars.device.fake import FakeMemory
    from vram_arbiter.sidecars.device.memory import Block

    memory = FakeMemory(Path(os.environ["VRAM_ARBITER_RUNTIME"]) / "fakegpu", "holder")
    blocks: list[Block] = []

    def free() -> None:
        memory.free(blocks.pop())
        memory.empty_cache()

    async def unload() -> None:
        await asyncio.to_thread(free)

    async with AsyncClient(name="holder") as client:
        async for command in _commands():
            match command:
                case "hold":
                    lease = await client.acquire(_spec("holder"), unload=unload)
                    memory.bind(lease.gpu)
                    blocks.append(memory.allocate("weights", 5 * GIB))
                    await lease.ready(5 * GIB)
                case "trace":
                    tracer.start()
                case "write":
                    tracer.stop()
            print(command, flush=True)
    memory.close()


async def waiter(tracer: Tracer) -> None:
    """Ask for the holder's place, and get it: `acquire`, `release`, `measure`."""
    from vram_arbiter.clients.client import AsyncClient

    async with AsyncClient(name="waiter") as client:
        spec = _spec("waiter")
        async for command in _commands():
            match command:
                case "acquire":
                    lease = await client.acquire(spec)
                case "release":
                    await lease.release()
                case "measure":
                    tracer.start()
                    await client.acquire(spec)
                    tracer.stop()
            print(command, flush=True)


async def _commands() -> AsyncIterator[str]:
    """Lines of stdin until it closes."""
    while line := await asyncio.to_thread(sys.stdin.readline):
        yield line.strip()


def _spec(consumer: str) -> Any:
    from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

    size = Footprint(load_peak_bytes=5 * GIB, steady_bytes=5 * GIB, residue_bytes=450 << 20)
    # a TTL without renewals in the measured time, and no minimum residency to wait for
    return LeaseSpec(
        consumer=consumer, model_id=consumer, footprint=size, ttl_s=600.0, min_residency_s=0.0
    )


# -- measuring
def record(folder: Path, *, cold: bool = False) -> dict[str, list[Step]]:
    """Play the scene twice, or once with `cold`. Returns the steps of each side in the last one."""
    arbiter = ArbiterProcess()
    make_gpu(arbiter.gpu_folder, 8 * GIB, release_lag_s=0.0)
    out = {side: folder / f"{side}.json" for side in ("daemon", "holder", "waiter")}
    arbiter.program = [sys.executable, str(Path(__file__)), "daemon", str(out["daemon"])]
    programs: dict[str, subprocess.Popen[str]] = {}

    def tell(side: str, command: str) -> None:
        program = programs[side]
        assert program.stdin is not None
        assert program.stdout is not None
        print(command, file=program.stdin, flush=True)
        if (line := program.stdout.readline().strip()) != command:
            raise RuntimeError(f"expected {command!r} from the {side}, got {line!r}")

    try:
        arbiter.start()
        for side in ("holder", "waiter"):
            programs[side] = subprocess.Popen(
                [sys.executable, str(Path(__file__)), side, str(out[side])],
                env=arbiter.environ,
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                text=True,
            )
        if not cold:
            tell("holder", "hold")
            tell("waiter", "acquire")
            tell("waiter", "release")
        tell("holder", "hold")
        tell("holder", "trace")
        os.kill(arbiter.pid, signal.SIGUSR1)
        _until(out["daemon"].with_suffix(".started").exists)
        tell("waiter", "measure")
        os.kill(arbiter.pid, signal.SIGUSR2)
        tell("holder", "write")
        for path in out.values():
            _until(path.exists)
        steps: dict[str, list[Step]] = {
            side: [(file, name, line) for file, name, line in json.loads(path.read_text())]
            for side, path in out.items()
        }
        return steps | {"daemon": until_granted(steps["daemon"])}
    finally:
        for program in programs.values():
            program.kill()
            program.communicate()
        arbiter.close()


def until_granted(steps: list[Step]) -> list[Step]:
    """Return the daemon's steps up to the end of the event in which it granted.

    All of them if the counting was turned off before that: the waiter hears of its grant earlier.
    """
    names = [(file, name) for file, name, _ in steps]
    rest = names[names.index(GRANT) :]
    return steps if LOOP not in rest else steps[: len(steps) - len(rest) + rest.index(LOOP)]


def _recorded(cold: bool) -> dict[str, list[Step]]:
    with tempfile.TemporaryDirectory(prefix="path") as folder:
        return record(Path(folder), cold=cold)


def _length(steps: Mapping[str, list[Step]]) -> int:
    return sum(map(len, steps.values()))


def _until(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE_S
    while not condition():
        if time.monotonic() > deadline:
            raise RuntimeError(f"not within {PATIENCE_S:g} s: {condition}")
        time.sleep(0.01)


def figures(
    steps: Mapping[str, list[Step]], lines: tuple[str, ...] = LINES
) -> dict[str, dict[str, int]]:
    """Files, functions and switches of each side and of the path: waiter, daemon and the evicted
    holder, one after the other.

    Of the path also the modules of the core, and their lines. `lines` do not count as functions.
    """
    told = {side: _counted(side_steps, lines) for side, side_steps in steps.items()}
    path = [*steps["waiter"], *steps["daemon"], *steps["holder"]]
    core = {file for file, _, _ in path if file.startswith("arbiter/core/")}
    core_lines = sum(len((ROOT / file).read_text().splitlines()) for file in core)
    told["path"] = _counted(path, lines) | {"core modules": len(core), "core lines": core_lines}
    return told


def _counted(path: list[Step], lines: tuple[str, ...]) -> dict[str, int]:
    switches = sum(before[0] != after[0] for before, after in pairwise(path))
    files = {file for file, _, _ in path}
    return {"files": len(files), "functions": len(_functions(path, lines)), "switches": switches}


def _functions(path: list[Step], lines: tuple[str, ...]) -> dict[Step, None]:
    """Return the functions of a path, in the order of their first call."""
    return dict.fromkeys(step for step in path if not step[1].endswith(lines))


def per_file(path: list[Step], lines: tuple[str, ...] = LINES) -> list[tuple[str, int, int]]:
    """File, functions and entries of each file on a path, most functions first."""
    entries = Counter(file for file, _, _ in path[:1])
    entries.update(after[0] for before, after in pairwise(path) if before[0] != after[0])
    functions = Counter(file for file, _, _ in _functions(path, lines))
    return sorted(
        ((file, functions[file], count) for file, count in entries.items()),
        key=lambda row: (-row[1], -row[2], row[0]),
    )


def main(arguments: list[str]) -> int:
    parser = argparse.ArgumentParser(description="length of the path of one acquire")
    parser.add_argument("--list", action="store_true", help="print the path itself")
    parser.add_argument("--files", action="store_true", help="print functions, entries per file")
    parser.add_argument(
        "--cold", action="store_true", help="count first-use work and generator expressions too"
    )
    asked = parser.parse_args(arguments)
    steps = min((_recorded(asked.cold) for _ in range(RUNS)), key=_length)
    lines = () if asked.cold else LINES
    if asked.list:
        for side, path in steps.items():
            seen = (f"{file}:{line} {name}" for file, name, line in _functions(path, lines))
            print(f"{side}:", *seen, sep="\n  ")
    if asked.files:
        for side in ("waiter", "daemon", "holder"):
            print(f"{side}: functions, entries")
            for file, functions, entries in per_file(steps[side], lines):
                print(f"  {functions:4} {entries:5}  {file}")
    for side, counts in figures(steps, lines).items():
        print(f"{side:8}" + "".join(f" {name} {count}  " for name, count in counts.items()))
    print("targets: " + ", ".join(f"{name} {most}" for name, most in TARGETS.items()))
    return 0


if __name__ == "__main__":
    match sys.argv[1:]:
        case ["daemon", out, *rest]:
            run_daemon(Tracer(Path(out)), rest)
        case ["holder", out]:
            asyncio.run(holder(Tracer(Path(out))))
        case ["waiter", out]:
            asyncio.run(waiter(Tracer(Path(out))))
        case arguments:
            raise SystemExit(main(arguments))
