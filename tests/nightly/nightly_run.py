"""The rule machines for a night: `python -m tests.nightly.nightly_run --histories 100000`.

Splits the histories over the cores, in processes of their own and each portion under a seed of its
own; writes a report with what the histories came by, so that a walk that reaches nothing shows. A
failure is shrunk and printed with the line that tells it again.
"""

import argparse
import importlib.util
import json
import multiprocessing
import os
import sys
import time
import traceback
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from hypothesis import Phase, seed, settings
from hypothesis.reporting import with_reporter
from hypothesis.stateful import RuleBasedStateMachine, run_state_machine_as_test

from tests.support import machines as profiles

ROOT = Path(__file__).resolve().parents[2]
MACHINES = {  # name → file and class; whoever stands here walks in the night
    "leases": ("tests/arbiter/core/test_machine.py", "Leases")
}
PORTION = 250  # histories under one seed
SPREAD = 1_000_003  # between the seeds of two nights


@dataclass(slots=True)
class Portion:
    """Some histories of one machine under one seed, and what came of them."""

    machine: str
    seed: int
    wanted: int
    histories: int = 0
    events: int = 0
    cpu_s: float = 0.0
    reached: dict[str, int] = field(default_factory=dict)
    failure: str = ""

    @property
    def again(self) -> str:
        """The line that tells it again."""
        return (
            f"python -m tests.nightly.nightly_run --machine {self.machine} --seed {self.seed}"
            f" --histories {self.wanted}"
        )


def load(machine: str) -> type[RuleBasedStateMachine]:
    """A machine from its test file."""
    path, name = MACHINES[machine]
    spec = importlib.util.spec_from_file_location(f"nightly_{machine}", ROOT / path)
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[spec.name] = module
    spec.loader.exec_module(module)
    found: type[RuleBasedStateMachine] = getattr(module, name)
    return found


def walk(portion: Portion, machine: type[RuleBasedStateMachine] | None = None) -> Portion:
    """Run a portion. A failure is told in it, shrunk."""
    before = settings.get_current_profile_name()
    profiles.register(portion.wanted)
    settings.load_profile(profiles.NIGHTLY)
    machine = load(portion.machine) if machine is None else machine
    reached: Counter[str] = Counter()

    class Counted(machine):  # type: ignore[misc, valid-type]  # a class that is known when it runs
        def teardown(self) -> None:
            super().teardown()
            portion.histories += 1
            driver = getattr(self, "driver", None)
            if driver is not None:
                portion.events += len(driver.events)
                reached.update(effect.kind for effect in driver.effects if hasattr(effect, "kind"))

    Counted.__name__ = Counted.__qualname__ = machine.__name__
    phases = [Phase.generate, Phase.shrink]
    chosen = settings(
        machine.TestCase.settings,
        max_examples=portion.wanted,
        derandomize=False,
        database=None,
        phases=phases,
        print_blob=True,
    )
    said: list[str] = []
    began = time.process_time()
    with with_reporter(said.append):
        try:
            run_state_machine_as_test(seed(portion.seed)(Counted), settings=chosen)
        except Exception:  # noqa: BLE001 - whatever a history ends with is what is looked for
            portion.failure = "\n".join([traceback.format_exc(), *map(str, said)])
    settings.load_profile(before)
    portion.cpu_s = round(time.process_time() - began, 2)
    portion.reached = dict(reached)
    return portion


def portions(machines: Sequence[str], histories: int, first_seed: int) -> list[Portion]:
    """The same number of histories for each machine, in portions; the machines take turns."""
    found: list[Portion] = []
    each = -(-histories // len(machines))
    for start in range(0, each, PORTION):
        for machine in machines:
            number = first_seed + len(found)
            found.append(Portion(machine, number, min(PORTION, each - start)))
    return found


def night(todo: Sequence[Portion], jobs: int, stop_at: int) -> list[Portion]:
    """Run all portions on `jobs` processes; no more are begun after `stop_at` failures."""
    done: list[Portion] = []
    with multiprocessing.get_context("spawn").Pool(jobs, maxtasksperchild=8) as pool:
        for portion in pool.imap_unordered(walk, todo):
            done.append(portion)
            if portion.failure:
                print(f"\n{portion.failure}\n\nagain: {portion.again}\n", flush=True)
            if sum(bool(one.failure) for one in done) >= stop_at:
                pool.terminate()
                break
            if len(done) % 10 == 0:
                print(f"{sum(one.histories for one in done)} histories", flush=True)
    return sorted(done, key=lambda one: one.seed)


def summary(done: Sequence[Portion], wall_s: float) -> dict[str, Any]:
    """The report: all, each machine, and the failures with the line that tells them again."""
    failures = [asdict(one) | {"again": one.again} for one in done if one.failure]
    total: dict[str, Any] = {
        "histories": 0,
        "events": 0,
        "wall_s": round(wall_s, 1),
        "machines": {},
    }
    for one in done:
        mine = total["machines"].setdefault(
            one.machine, {"histories": 0, "events": 0, "cpu_s": 0.0, "reached": Counter()}
        )
        mine["reached"].update(one.reached)
        mine["cpu_s"] = round(mine["cpu_s"] + one.cpu_s, 2)
        for key in ("histories", "events"):
            mine[key] += getattr(one, key)
            total[key] += getattr(one, key)
    for mine in total["machines"].values():
        mine["reached"] = dict(mine["reached"].most_common())
        mine["per_cpu_s"] = round(mine["histories"] / max(mine["cpu_s"], 0.01), 1)
    return total | {"seeds": [one.seed for one in done], "failures": failures}


def main() -> int:
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument(
        "--histories", type=int, default=profiles.NIGHTLY_EXAMPLES, help="of all machines together"
    )
    parser.add_argument("--machine", choices=sorted(MACHINES), help="this one alone")
    parser.add_argument("--seed", type=int, help="the first portion's; without it the day chooses")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument(
        "--stop-at", type=int, default=3, help="begin no more after so many failures"
    )
    parser.add_argument("--out", type=Path, default=ROOT / "out/nightly/report.json")
    options = parser.parse_args()
    first = int(time.time()) // 86_400 * SPREAD if options.seed is None else options.seed
    machines = [options.machine] if options.machine else sorted(MACHINES)
    began = time.perf_counter()
    done = night(portions(machines, options.histories, first), options.jobs, options.stop_at)
    report = summary(done, time.perf_counter() - began)
    options.out.parent.mkdir(parents=True, exist_ok=True)
    options.out.write_text(json.dumps(report, indent=1) + "\n")
    print(
        json.dumps(
            {key: value for key, value in report.items() if key not in ("seeds", "failures")},
            indent=1,
        )
    )
    return 1 if report["failures"] else 0


if __name__ == "__main__":
    sys.exit(main())
