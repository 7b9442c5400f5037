"""Mutation check of the engine: `python -m tests.mutation.mutation_run --sample 300 --out
out/mutation/report.json`.

A mutant is one function of `arbiter/core` with one small change (mutmut's operators: comparisons,
constants, `and`/`or`, arguments, …). It is killed if a test of `tests/arbiter/core` fails with it.
What survives is either a missing test or a change that means the same: every survivor is looked at,
and those that mean the same stand in `equivalent.json` beside this file, each with its reason.

pytest collects once. Each mutant is tried in a fork of that process: the mutant's bytecode takes
the place of the function's, so whoever imported the function has the mutant, and only the tests
themselves cost time. The rule machines are left out: they are slow, and what only they kill
deserves a test with a name. With `--explore 60`, what no test kills is tried by so many seconds of
`tests.explore`; the report names the world that kills it.
"""

import argparse
import ast
import difflib
import gc
import importlib
import inspect
import io
import json
import os
import random
import resource
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Iterator, Mapping
from contextlib import redirect_stdout
from dataclasses import dataclass
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, NoReturn

import pytest

from tests.explore.scenarios import SCENARIOS
from tests.explore.search import Search

ROOT = Path(__file__).resolve().parents[2]
CORE = ROOT / "arbiter/core"
IMPORTED = "/vram_arbiter/arbiter/core/"
"""In the path of every file of the engine as it is imported: through the links of `src`."""
TESTS = "tests/arbiter/core"
KNOWN = Path(__file__).with_name("equivalent.json")
TEST_TIMEOUT_S = 20
"""A test that takes longer has met a mutant that never ends; the slowest takes a second."""
MEMORY_MAX_BYTES = 8 * 1024**3
SURVIVED, KILLED, NO_EFFECT = 0, 1, 2


@dataclass(slots=True)
class Mutant:
    """One change. `name` says where it is; it stays the same while its function stays the same."""

    name: str
    stem: str
    lines: list[int]  # those that it changes, and the beginning of their statement
    diff: str
    source: str  # of the whole mutated module
    outcome: str = ""
    killer: str = ""
    seconds: float = 0.0

    @property
    def where(self) -> str:
        return self.name.rpartition(":")[0]

    @property
    def module(self) -> str:
        (path,) = CORE.rglob(f"{self.stem}.py")
        return ".".join(("vram_arbiter", *path.relative_to(CORE.parents[1]).with_suffix("").parts))


# -- which there are
def enumerate_file(path: Path) -> Iterator[tuple[str, Any, Any]]:
    """(name, the parsed module, the mutation) of each mutant of a file. Words for people (strings
    with a space) stay as they are."""
    import libcst as cst
    from mutmut.mutation.file_mutation import create_mutations

    parsed, mutations, _, _ = create_mutations(str(path), path.read_text())
    count: Counter[str] = Counter()
    for mutation in mutations:
        function = mutation.contained_by_top_level_function
        if not isinstance(function, cst.FunctionDef):
            continue
        node = mutation.original_node
        if isinstance(node, cst.SimpleString) and " " in node.value:
            continue
        where = f"{path.stem}.{_qualified(parsed, function)}"
        count[where] += 1
        yield f"{where}:{count[where]}", parsed, mutation


def _qualified(parsed: Any, function: Any) -> str:
    import libcst as cst

    for statement in parsed.body:
        if isinstance(statement, cst.ClassDef) and function in statement.body.body:
            return f"{statement.name.value}.{function.name.value}"
    return str(function.name.value)


def choose(
    sample: int, seed: int, only: Mapping[str, str], folder: Path = CORE
) -> tuple[int, list[Mutant]]:
    """How many mutants there are, and `sample` of them by chance (0: all), or exactly those of
    `only`: their names and diffs."""
    found = [item for path in sorted(folder.rglob("*.py")) for item in _of_file(path)]
    if only:
        return len(found), _again(found, only)
    some = 0 < sample < len(found)
    chosen = random.Random(seed).sample(found, sample) if some else found
    return len(found), [_materialise(*item) for item in chosen]


def _again(found: list[tuple[str, Path, Any, Any]], only: Mapping[str, str]) -> list[Mutant]:
    """Those mutants, by their name at first; where a function has changed, by their diff. To make
    one takes a while."""
    left = Counter((name.rpartition(":")[0], diff) for name, diff in only.items())
    chosen: list[Mutant] = []
    for item in sorted(found, key=lambda item: item[0] not in only):
        if not any(where == item[0].rpartition(":")[0] for where, _ in left):
            continue
        mutant = _materialise(*item)
        if (mutant.where, mutant.diff) in left:
            del left[mutant.where, mutant.diff]
            chosen.append(mutant)
    for where, _ in left:
        print(f"{where} has changed: one of its mutants is no more", flush=True)
    return chosen


def _of_file(path: Path) -> list[tuple[str, Path, Any, Any]]:
    return [(name, path, parsed, mutation) for name, parsed, mutation in enumerate_file(path)]


def _materialise(name: str, path: Path, parsed: Any, mutation: Any) -> Mutant:
    before = parsed.code
    after = parsed.deep_replace(mutation.original_node, mutation.mutated_node).code
    lines = list(difflib.unified_diff(before.splitlines(), after.splitlines(), lineterm="", n=0))[
        2:
    ]
    changed: set[int] = set()
    for entry in lines:
        if entry.startswith("@@"):
            first, _, count = entry.split()[1].removeprefix("-").partition(",")
            changed |= set(range(int(first), int(first) + int(count or 1)))
    diff = "\n".join(entry for entry in lines if not entry.startswith("@@"))
    return Mutant(
        name, path.stem, sorted(changed | _statement(before, min(changed, default=0))), diff, after
    )


def _statement(source: str, line: int) -> set[int]:
    """Lines of the innermost statement around a line, without the statements inside it."""
    best: set[int] = set()
    for node in ast.walk(ast.parse(source)):
        if isinstance(node, ast.stmt) and node.lineno <= line <= (node.end_lineno or node.lineno):
            inner = [
                child.lineno
                for child in ast.walk(node)
                if isinstance(child, ast.stmt) and child is not node
            ]
            end = min(inner, default=(node.end_lineno or node.lineno) + 1)
            span = set(range(node.lineno, max(end, node.lineno + 1)))
            if not best or min(span) >= min(best):
                best = span
    return best


# -- taking a function's place
def swap(module: Any, source: str) -> int:
    """Give the module's functions the bytecode of this source. Returns how many do something else
    now."""
    fresh: dict[str, Any] = {"__name__": module.__name__, "__file__": module.__file__}
    exec(compile(source, module.__file__, "exec"), fresh)
    theirs = dict(_functions(module.__name__, vars(module)))
    changed = 0
    for name, function in _functions(module.__name__, fresh):
        old = theirs[name]
        if _shape(old.__code__) != _shape(function.__code__):
            old.__code__ = function.__code__
            changed += 1
    return changed


def _functions(
    module: str, names: dict[str, Any], prefix: str = ""
) -> Iterator[tuple[str, FunctionType]]:
    for name, value in list(names.items()):
        if isinstance(value, type) and value.__module__ == module and not prefix:
            yield from _functions(module, dict(vars(value)), f"{name}.")
            continue
        if isinstance(value, property):
            value = value.fget
        elif isinstance(value, staticmethod | classmethod):
            value = value.__func__
        elif callable(value) and not isinstance(value, type):
            value = inspect.unwrap(value)
        if isinstance(value, FunctionType) and value.__module__ == module:
            yield prefix + name, value


def _shape(code: CodeType) -> tuple[Any, ...]:
    """What a function does, whatever lines it stands on."""
    constants = tuple(
        _shape(value) if isinstance(value, CodeType) else (type(value).__name__, repr(value))
        for value in code.co_consts
    )
    return code.co_code, constants, code.co_names, code.co_varnames, code.co_freevars


# -- trying them
class Coverage:
    """A pytest plugin that notes which test runs which lines of the engine."""

    def __init__(self) -> None:
        self.tests: dict[str, set[str]] = {}  # "file:line" → the tests that come by
        self.durations: dict[str, float] = {}
        self.lines: set[tuple[str, int]] = set()
        self._tool = sys.monitoring.COVERAGE_ID
        sys.monitoring.use_tool_id(self._tool, "mutation")
        sys.monitoring.register_callback(self._tool, sys.monitoring.events.LINE, self._line)
        sys.monitoring.set_events(self._tool, sys.monitoring.events.LINE)

    def _line(self, code: CodeType, line: int) -> object:
        if IMPORTED in code.co_filename:
            self.lines.add((Path(code.co_filename).stem, line))
        return sys.monitoring.DISABLE  # until the next test

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.durations[report.nodeid] = self.durations.get(report.nodeid, 0.0) + report.duration

    def pytest_runtest_logfinish(self, nodeid: str) -> None:
        for stem, line in self.lines:
            self.tests.setdefault(f"{stem}:{line}", set()).add(nodeid)
        self.lines.clear()
        sys.monitoring.restart_events()


class Trials:
    """A pytest plugin that runs, for each mutant and in a fork, the tests that come by its lines,
    until one fails."""

    def __init__(
        self, mutants: list[Mutant], jobs: int, folder: Path, explore_s: float = 0.0
    ) -> None:
        self.mutants = mutants
        self.explore_s = explore_s
        self.jobs = jobs
        self.folder = folder
        self.failed = ""
        self.running: dict[int, tuple[Mutant, float]] = {}
        self.tried = 0
        self.problem = ""

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed = self.failed or report.nodeid

    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        known = self._as_they_are(session.items)
        if known is None:
            return True
        tests, durations = known
        gc.collect()
        gc.freeze()  # forks share it
        items = sorted(session.items, key=lambda item: durations[item.nodeid])
        for mutant in self.mutants:
            near = set().union(*(tests.get(f"{mutant.stem}:{line}", ()) for line in mutant.lines))
            while len(self.running) >= self.jobs:
                self._reap()
            pid = os.fork()
            if pid == 0:
                self._run([item for item in items if item.nodeid in near], mutant)
            self.running[pid] = (mutant, time.perf_counter())
        while self.running:
            self._reap()
        return True

    def _as_they_are(
        self, items: list[pytest.Item]
    ) -> tuple[dict[str, list[str]], dict[str, float]] | None:
        """The tests without a mutant: all pass, and this is what each comes by."""
        kept = self.folder / "coverage.json"
        pid = os.fork()
        if pid == 0:
            coverage = Coverage()
            items[0].config.pluginmanager.register(coverage)
            self._run(
                items,
                None,
                lambda: kept.write_text(
                    json.dumps([coverage.tests, coverage.durations], default=list)
                ),
            )
        os.waitpid(pid, 0)
        if not kept.exists():
            self.problem = f"{self._words(pid)} fails as it is; mend it first"
            return None
        tests, durations = json.loads(kept.read_text())
        if not tests:
            self.problem = "no test comes by a line of the engine"
            return None
        return tests, durations

    def _run(
        self, items: list[pytest.Item], mutant: Mutant | None, then: Callable[[], object] = bool
    ) -> NoReturn:
        """In a fork: run these tests until one fails, and end."""
        status = KILLED  # whatever happens: a mutant that ends the process is dead
        try:
            nowhere = os.open(os.devnull, os.O_WRONLY)
            os.dup2(nowhere, 1)
            os.dup2(nowhere, 2)
            resource.setrlimit(resource.RLIMIT_AS, (MEMORY_MAX_BYTES, MEMORY_MAX_BYTES))
            if mutant is not None and not swap(
                importlib.import_module(mutant.module), mutant.source
            ):
                status = NO_EFFECT
                os._exit(status)
            for item, following in zip_longest(items, items[1:]):
                item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
                if self.failed:
                    break
            else:
                self.failed = "" if mutant is None else explored(self.explore_s)
            if not self.failed:
                status = SURVIVED
                then()
        finally:
            (self.folder / str(os.getpid())).write_text(self.failed)
            os._exit(status)

    def _words(self, pid: int) -> str:
        told = self.folder / str(pid)
        return told.read_text() if told.exists() else "the process ended"

    def _reap(self) -> None:
        pid, status = os.wait()
        mutant, began = self.running.pop(pid)
        code = os.waitstatus_to_exitcode(status)
        mutant.outcome = {SURVIVED: "survived", NO_EFFECT: "no effect"}.get(code, "killed")
        mutant.killer = self._words(pid) if mutant.outcome == "killed" else ""
        mutant.seconds = round(time.perf_counter() - began, 2)
        self.tried += 1
        if self.tried % 20 == 0:
            counts = dict(Counter(mutant.outcome for mutant in self.mutants if mutant.outcome))
            print(
                f"{self.tried} of {len(self.mutants)} tried: {counts}", file=sys.stderr, flush=True
            )


def explored(seconds: float) -> str:
    """Explore each scenario for its share of the time. Return the first failure; "" for none."""
    for name, scenario in SCENARIOS.items() if seconds else ():
        report = Search(scenario).run(seconds / len(SCENARIOS))
        if report.error:
            return f"explore {name}: {report.error}"
    return ""


def run(mutants: list[Mutant], jobs: int, explore_s: float) -> None:
    """Try all mutants, `jobs` at a time; each knows its outcome afterwards."""
    options = [
        TESTS,
        "--ignore-glob=*_machine.py",
        "-qq",
        "-p",
        "no:cacheprovider",
        "-p",
        "no:xdist",
    ]
    limits = ["-o", f"timeout={TEST_TIMEOUT_S}", "-o", "faulthandler_timeout=0"]
    os.chdir(ROOT)
    with tempfile.TemporaryDirectory() as folder, redirect_stdout(io.StringIO()) as said:
        trials = Trials(mutants, jobs, Path(folder), explore_s)
        pytest.main([*options, *limits], plugins=[trials])
    if any(not mutant.outcome for mutant in mutants):
        raise SystemExit(trials.problem or f"{said.getvalue()}\nnot every mutant was tried")


# -- what it says
def summary_of(existing: int, tried: list[Mutant], known: list[dict[str, str]]) -> dict[str, Any]:
    """The report. A survivor counts as equivalent while it is the very change that was judged."""
    judged = {(entry["where"], entry["diff"]) for entry in known}
    for mutant in tried:
        if mutant.outcome == "survived" and (mutant.where, mutant.diff) in judged:
            mutant.outcome = "equivalent"
    counts = Counter(mutant.outcome for mutant in tried)
    counted = counts["killed"] + counts["survived"]
    return {
        "mutants": existing,
        "sampled": len(tried),
        **{kind: counts[kind] for kind in ("killed", "survived", "equivalent", "no effect")},
        "score": round(counts["killed"] / counted, 4) if counted else None,
        "survivors": [
            {"name": m.name, "line": m.lines[-1], "diff": m.diff}
            for m in tried
            if m.outcome == "survived"
        ],
        "killed_by": {m.name: m.killer for m in tried if m.outcome == "killed"},
    }


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--sample", type=int, default=300, help="this many by chance; 0: all (hours)"
    )
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--explore", type=float, default=0.0, help="seconds of exploration for each survivor"
    )
    parser.add_argument("--again", type=Path, help="the survivors of this report")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, default=ROOT / "out/mutation/report.json")
    options = parser.parse_args()
    only: dict[str, str] = {}
    if options.again is not None:
        survivors = json.loads(options.again.read_text())["survivors"]
        only = {entry["name"]: entry["diff"] for entry in survivors}
    began = time.perf_counter()
    existing, mutants = choose(options.sample, options.seed, only)
    print(f"{existing} mutants, {len(mutants)} of them are tried", flush=True)
    known = json.loads(KNOWN.read_text())
    run(mutants, options.jobs, options.explore)
    report = summary_of(existing, sorted(mutants, key=lambda mutant: mutant.name), known)
    report |= {"seed": options.seed, "wall_s": round(time.perf_counter() - began, 1)}
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(report, indent=1, ensure_ascii=False) + "\n")
    for survivor in report["survivors"]:
        print(f"\n{survivor['name']} (line {survivor['line']}) survived:\n{survivor['diff']}")
    shown = {k: v for k, v in report.items() if k not in ("survivors", "killed_by")}
    print(json.dumps(shown))
    return 0


if __name__ == "__main__":
    sys.exit(main())
