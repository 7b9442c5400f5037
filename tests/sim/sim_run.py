"""Runs simulations: `python -m tests.sim.sim_run --seed 7` (one, with its story) or `--seeds 1000`
(0 … 999 on all cores).

One run: some consumers, runners, an observer and an operator live for a while under faults; then
the faults stop, everybody finishes what they began, and nothing may be left: no waiter, no lease,
no byte charged, no record in the journal.
"""

import argparse
import gc
import json
import logging
import multiprocessing
import os
import re
import signal
import sys
import threading
import time
import warnings
from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import Path

from tests.sim.sim_clients import Cast, Character, Consumer, Observer, Operator, Runner
from tests.sim.sim_faults import Nemesis, Slot
from tests.support.simulation.clock import TRACE_LINES
from tests.support.simulation.world import SimFailure, World, state_folder
from vram_arbiter.arbiter.core.model.lease import LeaseState
from vram_arbiter.schemas.ids import LeaseId

TROUBLE_S = 80.0
SETTLE_S = 150.0  # simulated: every wait, ageing, ladder and verification of the end fits in
PATIENCE_S = 10.0
MISBELIEF_S = 15.0  # longer than a holder waits for an answer, and the way back to the arbiter
CHUNK = 8
FAILURES_MAX = 5


@dataclass(slots=True)
class Report:
    """What one run did."""

    seed: int
    digest: str = ""
    failure: str = ""
    steps: int = 0
    events: int = 0
    granted: int = 0
    evicted: int = 0
    ooms: int = 0
    epochs: int = 0
    lost: int = 0
    duplicates: int = 0
    delays: int = 0
    dropped: int = 0
    seconds: float = 0.0
    faults: dict[str, int] = field(default_factory=dict)
    notes: dict[str, int] = field(default_factory=dict)
    verdicts: dict[str, int] = field(default_factory=dict)
    refusals: dict[str, int] = field(default_factory=dict)
    outcomes: dict[str, int] = field(default_factory=dict)


def run_seed(seed: int, lines_max: int | None = TRACE_LINES) -> Report:
    """One whole run. A breach is in `failure`, with the last lines of the story."""
    report = _run(seed, lines_max)
    hook = sys.unraisablehook
    sys.unraisablehook = lambda _: None
    try:
        with warnings.catch_warnings():
            # killed processes leave coroutines behind
            warnings.simplefilter("ignore", RuntimeWarning)
            gc.collect()
    finally:
        sys.unraisablehook = hook
    return report


def _run(seed: int, lines_max: int | None) -> Report:
    began = time.perf_counter()
    with state_folder() as folder:
        world = World(seed, folder, gpus=2 if seed % 3 == 2 else 1, lines_max=lines_max)
        cast = Cast(world)
        failure = ""
        try:
            _play(world, cast)
        except SimFailure as breach:
            failure = str(breach)
        for process in list(world.processes.values()):
            world.kill(process)
        world.kill_daemon("end")
        history = world.machine.history
        return Report(
            seed=seed,
            digest=world.clock.trace.digest(),
            failure=failure,
            steps=world.clock.steps,
            events=world.clock.trace.count,
            granted=cast.granted,
            evicted=cast.evicted,
            ooms=cast.ooms,
            epochs=len(world.machine.epochs),
            lost=world.wire.lost,
            duplicates=world.wire.duplicates,
            delays=world.wire.delays,
            dropped=world.wire.dropped,
            seconds=time.perf_counter() - began,
            faults=dict(world.faults),
            notes=dict(Counter(note.kind for note in history)),
            verdicts=dict(
                Counter(str(note.data["verdict"]) for note in history if note.kind == "verified")
            ),
            refusals=cast.refusals,
            outcomes=dict(Counter(ask.outcome for ask in cast.asks)),
        )


def _play(world: World, cast: Cast) -> None:
    random = world.clock.random
    world.entitlements = cast.entitlements
    world.start_daemon()
    rogue = world.seed % 2 == 1  # in every other run some consumers hold more than they said
    slots = []
    for n in range(random.randint(3, 6)):
        character = Character(
            grows=0.2 if rogue and n == 0 else 0.0,
            hides=0.2 if rogue and n == 1 else 0.0,
            leaks=0.2 if rogue and n == 2 else 0.0,
            leases=random.choice((1, 1, 2)),
        )
        slots.append(Slot(partial(Consumer, cast, f"consumer{n}", character)))
    slots += [Slot(partial(Runner, cast, f"runner{n}")) for n in range(2)]
    slots.append(Slot(partial(Observer, cast, "observer")))
    slots.append(Slot(partial(Operator, cast, "operator")))
    nemesis = Nemesis(world, cast, slots)
    _watch_beliefs(world, cast, {})
    world.run(TROUBLE_S)
    nemesis.calm()
    _settle(world, cast, nemesis)


def _watch_beliefs(world: World, cast: Cast, since: dict[str, float]) -> None:
    """No holder takes its lease for held while the arbiter waits for the end of its unload.
    `since`: when that was seen first, by lease."""
    daemon, now = world.daemon, world.clock.now
    known = daemon.core.inspect().leases if daemon is not None and world.serving else {}
    odd = [
        holding.lease.lease_id
        for holding in cast.living()
        if not holding.process.loop.frozen
        and (lease := known.get(LeaseId(holding.lease.lease_id))) is not None
        and lease.state is LeaseState.UNLOADING
    ]
    for lease_id in since.keys() - set(odd):
        del since[lease_id]
    for lease_id in odd:
        if now - since.setdefault(lease_id, now) > MISBELIEF_S:
            world.fail(f"{lease_id} unloads, says the arbiter, and its holder takes it for held")
    world.clock.after(1.0, lambda: _watch_beliefs(world, cast, since))


def _settle(world: World, cast: Cast, nemesis: Nemesis) -> None:
    """The faults are over. Everybody finishes; what is left then is a defect."""
    clock = world.clock
    clock.say("calm")
    until = clock.now + SETTLE_S

    def finished() -> bool:
        return all(program.done or not program.process.alive for program in nemesis.running)

    while not world.run(PATIENCE_S, finished):
        if clock.now < until:
            _let_a_residue_go(world, cast)
            continue
        waiting = [str(ask) for ask in cast.asks if not ask.outcome and ask.process.alive]
        still = [p.process.name for p in nemesis.running if not p.done and p.process.alive]
        world.fail(
            f"not over after {SETTLE_S} s: {still}, waiting {waiting}; status {_status(world)}"
        )
        world.raise_failure()
    for process in list(world.processes.values()):
        world.kill(process)
    daemon = world.daemon
    assert daemon is not None, "the daemon serves at the end"

    def empty() -> bool:
        core = daemon.core.inspect()
        return not core.leases and all(
            not gpu.ledger.accounts and not gpu.verifications for gpu in core.gpus.values()
        )

    if not world.run(SETTLE_S, empty):
        world.fail(f"not empty at the end: {_status(world)}")
    elif records := [key for key in daemon.records() if ":" in key]:
        world.fail(f"the journal keeps {records} of nobody")
    world.raise_failure()


def _status(world: World) -> str:
    assert world.daemon is not None, "the daemon serves at the end"
    return json.dumps(world.daemon.core.status(world.clock.now), default=str)


def _let_a_residue_go(world: World, cast: Cast) -> None:
    """What idle processes keep on the GPU (their contexts) can be all that is in the way, and only
    their exit frees it."""
    for ask in cast.asks:
        if ask.outcome or not ask.process.alive:
            continue
        others = 0
        for device in world.devices.values():
            keeps = [
                b
                for b in device.blocks()
                if b.tag in ("context", "leak") and b.process != ask.process.key
            ]
            others = max(others, sum(block.count for block in keeps))
        room = min(gpu.capacity_bytes - gpu.reserve_bytes for gpu in world.gpus) - others
        if others and ask.spec.footprint.load_peak_bytes > room:
            world.faults["exit_for_its_residue"] += 1
            world.kill(ask.process)
            return


# -- many
def run_many(seeds: Sequence[int], jobs: int) -> list[Report]:
    """All seeds, on `jobs` processes; stops early after some failures."""
    reports: list[Report] = []
    failed = 0
    with multiprocessing.get_context("spawn").Pool(jobs, initializer=_begin) as pool:
        for report in pool.imap_unordered(run_seed, seeds, chunksize=CHUNK):
            reports.append(report)
            if report.failure:
                failed += 1
                print(f"\n{report.failure}\n", flush=True)
                if failed >= FAILURES_MAX:
                    pool.terminate()
                    break
            if len(reports) % 100 == 0:
                print(f"{len(reports)} of {len(seeds)} seeds, {failed} failed", flush=True)
    return sorted(reports, key=lambda report: report.seed)


def _begin() -> None:
    """Begin a worker: it ends with the program that started it, and removes its folder."""
    _quiet()
    signal.signal(signal.SIGTERM, lambda *_: sys.exit())
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    parent = multiprocessing.parent_process()
    assert parent is not None
    parent.join()
    os.kill(os.getpid(), signal.SIGTERM)


def _quiet() -> None:
    logging.disable(logging.CRITICAL)


def summary(reports: Sequence[Report]) -> dict[str, object]:
    """Sums over runs."""
    total: dict[str, object] = {
        "seeds": len(reports),
        "failed": [r.seed for r in reports if r.failure],
    }
    for name in (
        "steps",
        "granted",
        "evicted",
        "ooms",
        "epochs",
        "lost",
        "duplicates",
        "delays",
        "dropped",
    ):
        total[name] = sum(getattr(report, name) for report in reports)
    for name in ("faults", "notes", "verdicts", "refusals", "outcomes"):
        counted: Counter[str] = Counter()
        for report in reports:
            counted.update(getattr(report, name))
        total[name] = dict(sorted(counted.items()))
    return total


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--seed", type=int, help="one seed, with the end of its story")
    parser.add_argument(
        "--grep", help="with --seed: its whole story, lines that match this expression"
    )
    parser.add_argument("--seeds", type=int, default=100, help="this many seeds, from --first on")
    parser.add_argument("--first", type=int, default=0)
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1)
    parser.add_argument("--out", type=Path, help="write the sums here, as JSON")
    options = parser.parse_args()
    _quiet()
    if options.seed is not None:
        report = run_seed(options.seed, None if options.grep else TRACE_LINES)
        lines = report.failure.splitlines()
        if options.grep:
            lines = [line for line in lines if re.search(options.grep, line)]
        print("\n".join(lines) or json.dumps(asdict(report), indent=1))
        return 1 if report.failure else 0
    began = time.perf_counter()
    reports = run_many(range(options.first, options.first + options.seeds), options.jobs)
    sums = summary(reports) | {"wall_s": round(time.perf_counter() - began, 1)}
    text = json.dumps(sums, indent=1)
    print(text)
    if options.out is not None:
        options.out.parent.mkdir(parents=True, exist_ok=True)
        options.out.write_text(text + "\n")
    return 1 if sums["failed"] else 0


if __name__ == "__main__":
    sys.exit(main())
