"""Fault injection on real processes: a daemon, consumers, a user of other processes' leases,
stowaways and attackers of the daemon's socket on one simulated GPU, hit at every named step of a
switch, for as long as is asked. An independent checker judges afterwards.

`make chaos SECONDS=300 SEED=0`, or `python -m tests.chaos.storm --seconds 300 --seed 0 --out
out/chaos`. Ends with 1 if anything that must not happen happened. What to hit and when is drawn
from the seed; when exactly it lands is the machine's doing, so a seed chooses the plan, not the
outcome. Steps are followed through the arbiter's own event stream, never by time.
"""

import argparse
import asyncio
import contextlib
import json
import os
import random
import resource
import shutil
import signal
import sqlite3
import statistics
import subprocess
import sys
import time
from collections import Counter, defaultdict
from collections.abc import AsyncIterator, Awaitable, Callable, Coroutine
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

from tests.support.attacks import ATTACKS
from tests.support.children import Child, spawn
from tests.support.fakegpu_check import check_log
from tests.support.lease_check import Finding, Hindrance, Story, check_leases, read_lines
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import MIB
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.testing.gpu import FakeGpu

STEPS = {
    "queued": "waiting",
    "granted": "loading",
    "ready": "held",
    "use_began": "in use",
    "revoke_asked": "revoking",
    "unloading": "unloading",
    "released": "verifying",
}
"""Event that begins a step → the step's name."""
ROLES = ("holder", "waiter", "bystander", "user", "daemon")
GPU_FAULTS = ("probe fails", "probe hangs", "leak", "lag", "hidden processes", "stowaway")
DISK_FAULTS = ("disk full", "file limit", "daemon restart")
ATTACK_FAULTS = tuple(f"attack: {attack}" for attack in ATTACKS)
CONSUMERS = 6
STRIKERS = 3
STEP_WAIT_S = 3.0
LAG_S = 0.1
CALM_S = 45.0
STATE_BYTES = 64 << 20
CONFIG = """
verify: {timeout_s: 1.0}
revoke: {remind_s: 0.5, deadline_s: 4.0}
lease: {fence_grace_s: 1.0}
probe: {deadline_s: 0.5, period_s: 0.5}
"""


@dataclass
class Tally:
    """Faults that were really injected: by kind, and by step and role."""

    by_kind: Counter[str] = field(default_factory=Counter)
    by_step: dict[str, Counter[str]] = field(default_factory=lambda: defaultdict(Counter))

    def count(self, kind: str, step: str = "any time") -> None:
        self.by_kind[kind] += 1
        self.by_step[step][kind] += 1


class Storm:
    """One run. `run` returns the report."""

    def __init__(self, seconds: float, seed: int, out: Path, faults: int = 0) -> None:
        self._seconds = seconds
        self._faults = faults  # as many at least, however long that takes on a busy machine
        self._seed = seed
        self._out = out
        self._random = random.Random(seed)
        self._arbiter = ArbiterProcess(config=CONFIG, prepared=True)
        self._traces = self._arbiter.runtime / "traces"
        self._traces.mkdir()
        self._mounted = self._mount_state()
        self._slots: dict[int, Child] = {}
        self._born = 0
        self._user: Child | None = None
        self._strangers: list[Child] = []
        self._children: list[Child] = []
        self._events: dict[tuple[int, float], JsonMap] = {}
        self._steps: dict[str, list[asyncio.Future[JsonMap]]] = defaultdict(list)
        self._queued: dict[str, str] = {}  # lease → consumer
        self._tasks: set[asyncio.Task[None]] = set()
        self._hindrances: list[Hindrance] = []
        self._outages: list[tuple[float, float]] = []  # of the daemon
        self._stopped: dict[int, Callable[[], None]] = {}  # by pid: how to let it go on
        self._tally = Tally()
        self._daemon_busy = asyncio.Lock()
        self._disk_is_full = False
        self._wall_minus_monotonic_s = time.time() - time.monotonic()
        self._findings: list[Finding] = []
        # what is still to be done of this turn: step, role, signal
        self._plan: list[tuple[str, str, str]] = []

    # -- the run
    async def run(self) -> dict[str, Any]:
        began = time.monotonic()
        usage: dict[str, Any] = {}
        try:
            await asyncio.to_thread(self._arbiter.start)
            self._set_gpu()
            watcher = asyncio.get_running_loop().create_task(self._watch())
            for slot in range(CONSUMERS):
                self._spawn_consumer(slot)
            self._spawn_user()
            strikers = [self._strike_until(began + self._seconds) for _ in range(STRIKERS)]
            await asyncio.gather(*strikers)
            await self._calm_down()
            usage = await self._settled()
            watcher.cancel()
            with contextlib.suppress(asyncio.CancelledError):
                await watcher
            code = await asyncio.to_thread(self._arbiter.stop)
            if code != 0:
                self._finding("daemon", f"the daemon ended with {code}")
            return self._report(time.monotonic() - began, usage)
        finally:
            self._close()

    def _close(self) -> None:
        for child in self._children:
            child.close()
        self._keep_evidence()
        if self._arbiter.process is not None and self._arbiter.process.poll() is None:
            self._arbiter.kill()
        if self._mounted:
            subprocess.run(["umount", str(self._arbiter.state)], check=False)
        self._arbiter.close()

    def _keep_evidence(self) -> None:
        """What a finding is looked into with: the last run's log, GPU log, traces and the workers'
        errors."""
        kept = self._out / "evidence"
        shutil.rmtree(kept, ignore_errors=True)
        kept.mkdir(parents=True)
        for path in (self._arbiter.runtime / "arbiter.log", self._arbiter.runtime / "errors.log"):
            if path.exists():
                shutil.copy(path, kept)
        if (log := self._arbiter.gpu_folder / fakegpu.LOG_FILE).exists():
            shutil.copy(log, kept / "gpu.jsonl")
        with (kept / "history.jsonl").open("w") as file:
            file.writelines(json.dumps(event) + "\n" for event in self._whole_history())
        lines = read_lines(path.read_text() for path in self._traces.iterdir())
        (kept / "traces.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
        (kept / "hindrances.json").write_text(
            json.dumps([asdict(found) for found in self._hindrances])
        )
        (kept / "outages.json").write_text(json.dumps(self._outages))

    def _finding(self, rule: str, text: str) -> None:
        self._findings.append(Finding(rule, time.monotonic(), text))

    # -- processes
    def _spawn(self, kind: str, name: str, what: str) -> Child:
        child = spawn(
            "storm-worker", kind, name, what, str(self._arbiter.gpu_folder), str(self._traces),
            name=name, environ=self._arbiter.environ,
            errors=self._arbiter.runtime / "errors.log",
        )  # fmt: skip
        self._children.append(child)
        return child

    def _spawn_consumer(self, slot: int) -> None:
        self._born += 1
        self._slots[slot] = self._spawn("consumer", f"c{slot}-{self._born}", str(self._seed))

    def _spawn_user(self) -> None:
        self._born += 1
        self._user = self._spawn("user", f"u-{self._born}", "-")

    # -- following the arbiter
    async def _watch(self) -> None:
        async with AsyncClient(
            "watch", endpoint=self._arbiter.endpoint, role="operator", connect_timeout_s=60.0
        ) as client:
            async for event in client.subscribe():
                self._heard(event)
                if (
                    event["kind"] == "ready"
                    and self._user is not None
                    and self._random.random() < 0.3
                ):
                    self._start(self._tell_user(client, str(event["lease_id"])))

    async def _tell_user(self, client: AsyncClient, lease: str) -> None:
        """Give the user a lease to mark a use on. Only an operator's status shows its token."""
        with contextlib.suppress(VramError):
            tokens = {view.lease_id: view.token for view in (await client.status()).leases}
            if self._user is not None and (token := tokens.get(lease)) is not None:
                self._user.tell(f"{lease} {token.epoch} {token.serial}")

    def _start(self, work: Coroutine[Any, Any, None]) -> None:
        task = asyncio.get_running_loop().create_task(work)
        self._tasks.add(task)
        task.add_done_callback(self._tasks.discard)

    def _heard(self, event: JsonMap) -> None:
        self._events[event["seq"], event["at_wall_s"]] = event
        kind, lease = event["kind"], event.get("lease_id")
        if kind == "queued":
            self._queued[str(lease)] = event["consumer"]
        elif lease is not None:
            self._queued.pop(lease, None)
        if step := STEPS.get(kind):
            waiting, self._steps[step] = self._steps[step], []
            for future in waiting:
                if not future.done():
                    future.set_result(event)

    async def _next(self, step: str) -> JsonMap | None:
        """The next event that begins a step; None if none comes soon."""
        future: asyncio.Future[JsonMap] = asyncio.get_running_loop().create_future()
        self._steps[step].append(future)
        try:
            return await asyncio.wait_for(future, STEP_WAIT_S)
        except TimeoutError:
            return None

    # -- striking
    async def _strike_until(self, end: float) -> None:
        """Every cell of step × role × signal in a shuffled order, again and again; faults of GPU
        and disk in between."""
        while time.monotonic() < end or not self._enough():
            if not self._plan:
                self._plan = [
                    (s, r, h) for s in STEPS.values() for r in ROLES for h in ("kill", "stop")
                ]
                self._plan += [
                    ("any time", "machine", fault)
                    for fault in (*GPU_FAULTS, *DISK_FAULTS, *ATTACK_FAULTS) * 2
                ]
                self._random.shuffle(self._plan)
            step, role, how = self._plan.pop()
            if role == "machine":
                await self._strike_machine(how)
            elif (event := await self._next(step)) is not None:
                await self._strike_process(step, role, how, event)
            await asyncio.sleep(self._random.uniform(0.05, 0.4))

    def _enough(self) -> bool:
        """Of faults as many as were wanted at least, and of grants half as many: a storm in which
        nobody loads shows nothing."""
        grants = sum(event["kind"] == "granted" for event in self._events.values())
        return sum(self._tally.by_kind.values()) >= self._faults and 2 * grants >= self._faults

    async def _strike_process(self, step: str, role: str, how: str, event: JsonMap) -> None:
        if role == "daemon":
            await self._strike_daemon(step, how)
            return
        target = self._target(role, event)
        if target is None or target.pid in self._stopped or not target.alive:
            return
        self._tally.count(f"{'SIGKILL' if how == 'kill' else 'SIGSTOP'} {role}", step)
        if how == "stop":
            self._stop(target)
            return
        self._hindrances.append(Hindrance(target.pid, time.monotonic(), float("inf")))
        target.kill()
        self._replace(target)

    def _target(self, role: str, event: JsonMap) -> Child | None:
        if role == "user":
            return self._user
        holder: str = event.get("consumer", "")
        if role == "holder":
            names = {holder}
        elif role == "waiter":
            names = set(self._queued.values()) - {holder} or {holder}
        else:
            names = {child.name for child in self._slots.values()} - {
                holder,
                *self._queued.values(),
            }
        found = [child for child in self._slots.values() if child.name in names]
        return self._random.choice(found) if found else None

    def _replace(self, dead: Child) -> None:
        if dead is self._user:
            self._spawn_user()
            return
        for slot, child in self._slots.items():
            if child is dead:
                self._spawn_consumer(slot)
                return

    def _stop(self, target: Child) -> None:
        """SIGSTOP now, SIGCONT later: mostly a hiccup, sometimes longer than its ttl, the grace and
        the verification."""
        since = time.monotonic()
        target.signal(signal.SIGSTOP)

        def go_on() -> None:
            if self._stopped.pop(target.pid, None) is not None:
                self._hindrances.append(Hindrance(target.pid, since, time.monotonic()))
                target.signal(signal.SIGCONT)

        self._stopped[target.pid] = go_on
        asyncio.get_running_loop().call_later(self._pause_s(), go_on)

    def _pause_s(self) -> float:
        return self._random.choice([0.1, 0.2, 0.3, 0.5, 0.8, 1.5, 6.0])

    async def _strike_daemon(self, step: str, how: str) -> None:
        if self._daemon_busy.locked():
            return
        async with self._daemon_busy, self._daemon_is_out():
            if how == "kill":
                self._tally.count("SIGKILL daemon", step)
                await asyncio.to_thread(self._arbiter.kill)
                await asyncio.sleep(self._random.choice([0.0, 0.0, 0.0, 0.5, 2.5]))
                await self._start_daemon()
                return
            self._tally.count("SIGSTOP daemon", step)
            os.kill(self._arbiter.pid, signal.SIGSTOP)
            await asyncio.sleep(self._random.choice([0.1, 0.2, 0.5, 0.5, 4.0]))
            os.kill(self._arbiter.pid, signal.SIGCONT)

    @contextlib.asynccontextmanager
    async def _daemon_is_out(self) -> AsyncIterator[None]:
        since = time.monotonic()
        yield
        self._outages.append((since, time.monotonic()))

    async def _start_daemon(self) -> None:
        """A full disk may forbid a start, and it says so; then it is emptied first, as an operator
        would.

        It may be empty again by the time that the start has failed: what counts is how the start
        found it.
        """
        found_full = self._disk_is_full
        try:
            await asyncio.to_thread(self._arbiter.start)
        except RuntimeError:
            if not found_full:
                raise
            self._empty_disk()
            await asyncio.to_thread(self._arbiter.start)

    # -- faults of the machine
    async def _strike_machine(self, fault: str) -> None:
        pause_s = self._random.uniform(0.3, 2.5)
        match fault:
            case "daemon restart":
                if self._daemon_busy.locked():
                    return
                self._tally.count(fault)
                async with self._daemon_busy, self._daemon_is_out():
                    if (code := await asyncio.to_thread(self._arbiter.stop)) != 0:
                        self._finding("daemon", f"the daemon ended with {code} at a restart")
                    await self._start_daemon()
            case "disk full" | "file limit":
                await self._strike_disk(fault, pause_s)
            case "stowaway":
                self._tally.count(fault)
                self._born += 1
                size = self._random.choice([300, 800, 2000]) * MIB
                child = self._spawn("stowaway", f"s-{self._born}", str(size))
                self._strangers.append(child)
                self._later(pause_s, child.hang_up)
            case _ if fault in ATTACK_FAULTS:
                self._tally.count(fault)
                self._born += 1
                attack = fault.removeprefix("attack: ")
                self._strangers.append(
                    self._spawn("attacker", f"x-{self._born}", f"{attack}:{pause_s:.2f}")
                )
            case _:
                self._tally.count(fault)
                settings: dict[str, dict[str, Any]] = {
                    "probe fails": {"faults": {"probe": "fail"}},
                    "probe hangs": {"faults": {"probe": "hang"}},
                    "leak": {"faults": {"leak_bytes": 600 * MIB}},
                    "hidden processes": {"faults": {"hide_processes": True}},
                    "lag": {"release_lag_s": 0.7},
                }
                await asyncio.to_thread(self._set_gpu, **settings[fault])
                self._later(pause_s, self._mend_gpu)

    async def _strike_disk(self, fault: str, pause_s: float) -> None:
        if self._disk_is_full or self._daemon_busy.locked():
            return
        self._disk_is_full = True
        if fault == "disk full" and self._mounted:
            self._tally.count("disk full")
            filler = self._arbiter.state / "filler"
            with contextlib.suppress(OSError), filler.open("wb", buffering=0) as file:
                while file.write(b"\0" * 65_536):
                    pass
        else:
            self._tally.count("file limit")
            _, hard = resource.prlimit(self._arbiter.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(self._arbiter.pid, resource.RLIMIT_FSIZE, (1024, hard))
        self._later(pause_s, self._empty_disk)

    def _empty_disk(self) -> None:
        if not self._disk_is_full:
            return
        self._disk_is_full = False
        (self._arbiter.state / "filler").unlink(missing_ok=True)
        with contextlib.suppress(ProcessLookupError):
            _, hard = resource.prlimit(self._arbiter.pid, resource.RLIMIT_FSIZE)
            resource.prlimit(self._arbiter.pid, resource.RLIMIT_FSIZE, (hard, hard))

    def _mend_gpu(self) -> None:
        self._start(asyncio.to_thread(self._set_gpu))

    def _set_gpu(self, release_lag_s: float = LAG_S, faults: dict[str, Any] | None = None) -> None:
        """Not on the loop: whoever holds the GPU's lock may have been stopped, and the loop lets
        it go on."""
        gpu = FakeGpu(self._arbiter.gpu_folder)
        gpu.edit(release_lag_s=release_lag_s, faults=faults or {})

    def _mount_state(self) -> bool:
        """A small disk for the daemon's state, where mounting is permitted."""
        self._arbiter.state.mkdir(mode=0o700)
        mounted = subprocess.run(
            [
                "mount",
                "-t",
                "tmpfs",
                "-o",
                f"size={STATE_BYTES},mode=0700",
                "none",
                str(self._arbiter.state),
            ],
            check=False,
            capture_output=True,
        )
        return mounted.returncode == 0

    def _later(self, delay_s: float, action: Callable[[], None]) -> None:
        asyncio.get_running_loop().call_later(delay_s, action)

    # -- afterwards
    async def _calm_down(self) -> None:
        """Faults end, everybody goes on, finishes and leaves. Who does not is a finding."""
        for go_on in list(self._stopped.values()):
            go_on()
        self._empty_disk()
        await asyncio.gather(*self._tasks)
        await asyncio.to_thread(self._set_gpu)
        for stranger in self._strangers:
            stranger.hang_up()
        everybody = [*self._slots.values(), *self._strangers, *([self._user] if self._user else [])]
        for child in self._slots.values():
            child.signal(signal.SIGTERM)
        if self._user is not None:
            self._user.hang_up()
        loop = asyncio.get_running_loop()
        deadline = loop.time() + CALM_S
        for child in everybody:
            try:
                await asyncio.to_thread(child.wait, max(0.1, deadline - loop.time()))
            except AssertionError:
                self._finding(
                    "stuck", f"{child.name} did not finish within {CALM_S:g} s after the last fault"
                )

    async def _settled(self) -> dict[str, Any]:
        """Nothing is left: no lease, no byte, no connection but ours."""
        status: dict[str, Any] = {}

        async def clean(client: AsyncClient) -> bool:
            nonlocal status
            status = to_map(await client.status())
            return (
                not status["leases"]
                and status["phase"] == "serving"
                and all(gpu["charged_bytes"] == 0 for gpu in status["gpus"])
                and all(gpu["measured_used_bytes"] == 0 for gpu in status["gpus"])
            )

        async with AsyncClient(
            "settled", endpoint=self._arbiter.endpoint, connect_timeout_s=30.0
        ) as client:
            if not await _eventually(lambda: clean(client), CALM_S):
                self._finding(
                    "leak", f"something is left after everybody has gone: {json.dumps(status)}"
                )
        fds = len(os.listdir(f"/proc/{self._arbiter.pid}/fd"))
        memory = Path(f"/proc/{self._arbiter.pid}/status").read_text()
        rss = next(line for line in memory.splitlines() if line.startswith("VmRSS")).split()[1]
        if fds > 60:
            self._finding("leak", f"the daemon has {fds} descriptors open")
        return {"daemon_fds": fds, "daemon_rss_kib": int(rss), "clients": status.get("clients")}

    def _report(self, seconds: float, usage: dict[str, Any]) -> dict[str, Any]:
        log = (self._arbiter.gpu_folder / fakegpu.LOG_FILE).read_text()
        traces = read_lines(path.read_text() for path in self._traces.iterdir())
        gpu = check_log(log)
        story = check_leases(
            log,
            self._whole_history(),
            traces,
            self._hindrances,
            outages=self._outages,
            wall_minus_monotonic_s=self._wall_minus_monotonic_s,
        )
        found = [
            *self._findings,
            *(Finding("gpu", 0.0, problem) for problem in gpu.problems),
            *story.findings,
        ]
        return {
            "seed": self._seed,
            "seconds": round(seconds, 1),
            "wall_minus_monotonic_s": self._wall_minus_monotonic_s,
            "violations": [asdict(finding) for finding in found],
            "faults": {
                "total": sum(self._tally.by_kind.values()),
                "by_kind": dict(sorted(self._tally.by_kind.items())),
                "by_step": {
                    step: dict(sorted(kinds.items())) for step, kinds in self._tally.by_step.items()
                },
            },
            "disk": "tmpfs and file limit" if self._mounted else "file limit only",
            **_figures(story),
            "gpu": {
                "changes": gpu.lines,
                "processes": gpu.processes,
                "peak_bytes": gpu.peak_bytes,
                "capacity_bytes": gpu.capacity_bytes,
                "refused": gpu.oom_events,
                "torn_lines": gpu.torn_lines,
            },
            "after": usage,
        }

    def _whole_history(self) -> list[JsonMap]:
        """What the subscriber heard and what the disk kept: each may miss what the other has."""
        found = dict(self._events)
        with contextlib.closing(
            sqlite3.connect(self._arbiter.state / "history.sqlite")
        ) as database:
            for (text,) in database.execute("SELECT json FROM events"):
                event = json.loads(text)
                found[event["seq"], event["at_wall_s"]] = event
        return [found[key] for key in sorted(found, key=lambda key: (key[1], key[0]))]


def _figures(story: Story) -> dict[str, Any]:
    waits = sorted(story.waits)
    return {
        "grants": story.grants,
        "switches": story.switches,
        "evictions": story.evictions,
        "uses": story.uses,
        "allocations": story.allocations,
        "late_allocations": story.late_allocations,
        "refusals_excused": story.refusals_excused,
        "waits": len(waits),
        "wait_p50_s": round(statistics.median(waits), 3) if waits else None,
        "wait_max_s": round(waits[-1], 3) if waits else None,
    }


async def _eventually(condition: Callable[[], Awaitable[bool]], limit_s: float) -> bool:
    deadline = time.monotonic() + limit_s
    while time.monotonic() < deadline:
        with contextlib.suppress(VramError):
            if await condition():
                return True
        await asyncio.sleep(0.1)
    return False


def main() -> int:
    parser = argparse.ArgumentParser(
        description="Hit every process at every step of a switch, and judge what came of it."
    )
    parser.add_argument("--seconds", type=float, default=300.0)
    parser.add_argument("--faults", type=int, default=0, help="go on until there were so many")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("out/chaos"))
    options = parser.parse_args()
    options.out.mkdir(parents=True, exist_ok=True)
    report = asyncio.run(Storm(options.seconds, options.seed, options.out, options.faults).run())
    (options.out / "report.json").write_text(json.dumps(report, indent=2) + "\n")
    faults = report["faults"]
    for kind, count in faults["by_kind"].items():
        print(f"{count:6}  {kind}")
    print(
        f"{faults['total']} faults at {len(faults['by_step'])} steps in {report['seconds']} s: "
        f"{report['grants']} grants, "
        f"{report['switches']} switches, {report['uses']} uses, wait p50 {report['wait_p50_s']} s, "
        f"max {report['wait_max_s']} s"
    )
    for finding in report["violations"]:
        print(f"VIOLATION {finding['rule']}: {finding['text']}")
    print(f"{len(report['violations'])} violations; see {options.out / 'report.json'}")
    return 1 if report["violations"] else 0


if __name__ == "__main__":
    sys.exit(main())
