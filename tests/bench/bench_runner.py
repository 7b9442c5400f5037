"""How well `vram-runner sim` holds its 30 Hz, alone and while sidecars switch beside it. Writes
`out/bench/runner.json`.

Real processes: arbiter, simulator with physics, cameras and video as in the demo, and two sidecars
with the shipped checkpoints that do not fit the GPU together, so that each load throws the other
out. One run has stretches with nothing beside and stretches with one switch after the other; the
runner itself notes when each tick began (`--timings`), and ticks are told apart by the stretch in
which they began.

No goal runs in the stretches: ticks step the physics and observe, pictures are rendered for the
detector, and the video repeats its last one, as it does while nothing moves.

*Jitter* is how far behind its slot a tick began. A slot that a long tick ate is no tick, and not in
it; the row *from one start to the next* has such gaps, as a whole period each.
"""

import asyncio
import itertools
import json
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AsyncExitStack, ExitStack, contextmanager
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from tests.bench.harness import SHIPPED, arbiter, p50, p99
from tests.support.attacks import WITHOUT_A_SESSION
from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from tests.support.running import attacked
from vram_arbiter.clients.runner import RunnerClient
from vram_arbiter.clients.sidecar.perception import DetectorClient
from vram_arbiter.clients.sidecar.policy import PolicyClient
from vram_arbiter.schemas.errors import RunnerUnreachable, SidecarUnavailable
from vram_arbiter.schemas.estop import REPLY_MAX_BYTES, Answer, path_of, reply_in, request
from vram_arbiter.schemas.goals import CancelGoal

SKILLS = {"detector": "so101-detector", "grab": "so101-grab"}
GRAB = "vram-arbiter/so101-grab"
NAVIGATE = "vram-arbiter/so101-navigate"
TURN_RAD = 6.0  # some eight seconds of driving
RATE_HZ = 30.0
JITTER_MAX_US = 2000.0
STOP_MAX_US = 10_000.0
STOP_PAUSE_S = 0.01
NO_HOLD = (
    "scheduling:\n  thrash_hold_max_s: 0\n"  # it would slow down on purpose what is measured here
)
# of each, on 8 GiB; without the simulated bandwidth of a real load there are more switches in a
# second
FOOTPRINT = "5GB,5GB,450MiB"
BOOT_S = 240.0
SETTLE_S = 3.0  # after the start: imports, first pictures, page cache
POLL_S = 0.1
END_S = 30.0


@dataclass(frozen=True, slots=True)
class Extent:
    """How much is measured: rounds of stretches, their length, and emergency stops."""

    rounds: int
    stretch_s: float
    stops: int


FULL = Extent(rounds=4, stretch_s=15.0, stops=200)
QUICK = Extent(rounds=1, stretch_s=1.5, stops=50)

Tick = dict[str, float]
Stretch = tuple[float, float]  # monotonic seconds


@dataclass(slots=True)
class RunnerRow:
    """One row of the file. `idle_p99_us` is the same with nothing beside, `ratio` p99 over that;
    `target` in words."""

    name: str
    p50_us: float | None = None
    p99_us: float | None = None
    idle_p99_us: float | None = None
    ratio: float | None = None
    target: str | None = None
    ok: bool | None = None


def run(*, quick: bool, out: Path) -> list[RunnerRow]:
    """Measure and write. Raises RuntimeError when a program ends by itself."""
    with arbiter(SHIPPED + NO_HOLD) as daemon:
        measured = asyncio.run(_measure(daemon, QUICK if quick else FULL))
    rows = measured.rows()
    out.parent.mkdir(parents=True, exist_ok=True)
    out.write_text(json.dumps([asdict(row) for row in rows], indent=1, ensure_ascii=False) + "\n")
    return rows


def table(rows: Sequence[RunnerRow]) -> str:
    """For people."""
    lines = [f"{'':46}{'p50 µs':>12}{'p99 µs':>12}{'idle p99':>12}{'ratio':>8}  {'':5}target"]
    for row in rows:
        cells = "".join(
            f"{'' if x is None else f'{x:.0f}':>12}"
            for x in (row.p50_us, row.p99_us, row.idle_p99_us)
        )
        ratio = "" if row.ratio is None else f"{row.ratio:.2f}"
        ok = {True: "ok", False: "MISS", None: ""}[row.ok]
        lines.append(f"{row.name:46}{cells}{ratio:>8}  {ok:5}{row.target or ''}".rstrip())
    return "\n".join(lines)


@dataclass(slots=True)
class Measured:
    ticks: list[Tick]
    idle: list[Stretch]
    switching: list[Stretch]
    starting: list[Stretch]
    driving: list[Stretch]
    driving_beside: list[Stretch]
    switches_us: list[float]
    goals_us: list[float]
    cold_goals_us: list[float]
    attacked: list[Stretch]
    attacked_state_us: list[float]
    stops_us: list[float]
    attacked_stops_us: list[float]

    def rows(self) -> list[RunnerRow]:
        alone, beside = self._within(self.idle), self._within(self.switching)
        idle, busy, starting = _all(alone), _all(beside), _all(self._within(self.starting))
        jitter = _compare("tick_jitter", _us(busy, "late_ms"), _us(idle, "late_ms"))
        assert jitter.p99_us is not None
        jitter.target, jitter.ok = "p99 < 2 ms", jitter.p99_us < JITTER_MAX_US
        attacked = _compare(
            "tick_jitter under attack",
            _us(_all(self._within(self.attacked)), "late_ms"),
            _us(idle, "late_ms"),
        )
        assert attacked.p99_us is not None
        attacked.target, attacked.ok = "p99 < 2 ms", attacked.p99_us < JITTER_MAX_US
        stops = _compare(
            "emergency stop under attack: asked to latched", self.attacked_stops_us, self.stops_us
        )
        assert stops.p99_us is not None
        stops.target, stops.ok = "p99 < 10 ms", stops.p99_us < STOP_MAX_US
        driven, driven_beside = self._within(self.driving), self._within(self.driving_beside)
        return [
            jitter,
            attacked,
            stops,
            RunnerRow("state, asked by another client under attack", p50(self.attacked_state_us),
            p99(self.attacked_state_us)),
            _compare(
                "tick_jitter while it drives and is filmed",
                _us(_all(driven_beside), "late_ms"),
                _us(_all(driven), "late_ms"),
            ),
            _compare(
                "tick_jitter while a sidecar starts (imports)",
                _us(starting, "late_ms"),
                _us(idle, "late_ms"),
            ),
            _compare("tick: time from one start to the next, off by", _uneven(beside),
            _uneven(alone)),
            _compare("... while it drives and is filmed", _uneven(driven_beside), _uneven(driven)),
            _compare("tick: decide (world state, no skill; others' pictures)", _decide_us(busy),
            _decide_us(idle)),
            _compare("tick: apply (physics, a video that stands still)", _us(busy, "hal_ms"),
            _us(idle, "hal_ms")),
            _compare("... while it drives and is filmed", _us(_all(driven_beside), "hal_ms"),
            _us(_all(driven), "hal_ms")),
            RunnerRow("switch: one sidecar out, the other in, asked", p50(self.switches_us),
            p99(self.switches_us)),
            RunnerRow("goal of one tick, policy resident", p50(self.goals_us), p99(self.goals_us)),
            RunnerRow("goal of one tick, policy to be loaded", p50(self.cold_goals_us),
            p99(self.cold_goals_us)),
        ]  # fmt: skip

    def _within(self, stretches: Sequence[Stretch]) -> list[list[Tick]]:
        """The ticks of each stretch."""
        found = [[t for t in self.ticks if a <= t["started_s"] < b] for a, b in stretches]
        if not all(found):
            raise RuntimeError("no tick was noted: the runner did not run, or wrote no timings")
        return found


def _all(stretches: Sequence[Sequence[Tick]]) -> list[Tick]:
    return list(itertools.chain.from_iterable(stretches))


def _us(ticks: Sequence[Tick], field: str) -> list[float]:
    return [tick[field] * 1e3 for tick in ticks]


def _decide_us(ticks: Sequence[Tick]) -> list[float]:
    return [(tick["tick_ms"] - tick["hal_ms"]) * 1e3 for tick in ticks]


def _uneven(stretches: Sequence[Sequence[Tick]]) -> list[float]:
    """How much more or less than a period lies between the starts of neighbours in a stretch,
    however long the loop stood still. A slot that a long tick ate counts as a whole period."""
    gaps = [
        b["started_s"] - a["started_s"] for ticks in stretches for a, b in itertools.pairwise(ticks)
    ]
    return [abs(gap - 1 / RATE_HZ) * 1e6 for gap in gaps]


def _compare(name: str, busy: Sequence[float], idle: Sequence[float]) -> RunnerRow:
    return RunnerRow(name, p50(busy), p99(busy), p99(idle), p99(busy) / max(p99(idle), 1e-3))


# -- the run
async def _measure(daemon: ArbiterProcess, extent: Extent) -> Measured:
    found = Measured([], [], [], [], [], [], [], [], [], [], [], [], [])
    timings = daemon.runtime / "ticks.jsonl"
    video = daemon.runtime / "episode.mp4"
    words = [
        "vram_arbiter.runner",
        "sim",
        "--seed",
        "1",
        "--video",
        str(video),
        "--timings",
        str(timings),
    ]
    async with AsyncExitStack() as stack:
        sidecars = {name: stack.enter_context(_sidecar(daemon, name)) for name in SKILLS}
        detector = await stack.enter_async_context(
            DetectorClient(f"ipc://{daemon.runtime}/detector.sock")
        )
        grab = await stack.enter_async_context(PolicyClient(f"ipc://{daemon.runtime}/grab.sock"))
        runner = await stack.enter_async_context(
            RunnerClient(f"ipc://{daemon.runtime}/runner.sock")
        )
        with _program(daemon, "runner", words) as process:
            await _until_up(runner.ping, [process, *sidecars.values()])
            for sidecar in (detector, grab):
                await _until_up(sidecar.ping, [process, *sidecars.values()])
            await _switch(runner, detector, grab)
            await asyncio.sleep(SETTLE_S)
            stretch_s = extent.stretch_s
            for _ in range(extent.rounds):
                began = time.monotonic()
                await asyncio.sleep(stretch_s)
                found.idle.append((began, time.monotonic()))
                began = time.monotonic()
                while time.monotonic() - began < stretch_s:
                    found.switches_us += await _switch(runner, detector, grab)
                found.switching.append((began, time.monotonic()))
                await _drive(found, runner, detector, grab, stretch_s)
            found.starting.append(await _start_another(daemon, [process]))
            await _goals(found, runner, detector, grab, 3 * extent.rounds)
            for attack in WITHOUT_A_SESSION:
                await _attacked(found, runner, attack, stretch_s / 2)
            await _stops(found, runner, extent.stops)
    found.ticks = [json.loads(line) for line in timings.read_text().splitlines()]
    return found


async def _switch(
    runner: RunnerClient, detector: DetectorClient, grab: PolicyClient
) -> list[float]:
    """Detector in and policy out, with a picture of the runner's as a reasoner would send; then the
    other way. Microseconds of each."""
    began = time.perf_counter()
    frame = await runner.frame("front", encoding="png")
    await detector.detect(frame["data"], "red cube", timeout_s=BOOT_S)
    seen = time.perf_counter()
    await grab.load(timeout_s=BOOT_S)
    return [(seen - began) * 1e6, (time.perf_counter() - seen) * 1e6]


async def _drive(
    found: Measured,
    runner: RunnerClient,
    detector: DetectorClient,
    grab: PolicyClient,
    stretch_s: float,
) -> None:
    """The robot turns on the spot, to and fro, and every third tick renders a picture for the
    video: first with nothing beside, then with switches."""

    async def turn() -> None:
        for way in itertools.cycle((TURN_RAD, -TURN_RAD)):
            goal = await runner.send_goal(NAVIGATE, goal_params={"turn_rad": way})
            result = await goal.result(BOOT_S)
            if result["status"] != "succeeded":
                raise RuntimeError(f"the robot does not drive: {result}")

    async with asyncio.TaskGroup() as tasks:
        driving = tasks.create_task(turn())
        await asyncio.sleep(SETTLE_S)  # the arm folds first
        began = time.monotonic()
        await asyncio.sleep(stretch_s)
        found.driving.append((began, time.monotonic()))
        began = time.monotonic()
        while time.monotonic() - began < stretch_s:
            await _switch(runner, detector, grab)
        found.driving_beside.append((began, time.monotonic()))
        driving.cancel()
    await _until_idle(runner)


async def _until_idle(runner: RunnerClient) -> None:
    """Take back the goal that the cancelled task left running."""
    if (goal_id := (await runner.state())["goal"]) is not None:
        await runner.call(CancelGoal(goal_id=goal_id))
    async with asyncio.timeout(END_S):
        while (await runner.state())["goal"] is not None:
            await asyncio.sleep(POLL_S)


async def _goals(
    found: Measured, runner: RunnerClient, detector: DetectorClient, grab: PolicyClient, count: int
) -> None:
    """From asking to the result of a goal that may move for one tick: acceptance, residency, use,
    reset, arm and back."""
    for _ in range(count):
        await grab.load(timeout_s=BOOT_S)
        found.goals_us.append(await _goal(runner))
        frame = await runner.frame("front", encoding="png")
        await detector.detect(frame["data"], "red cube", timeout_s=BOOT_S)
        found.cold_goals_us.append(await _goal(runner))


async def _attacked(found: Measured, runner: RunnerClient, attack: str, stretch_s: float) -> None:
    """Another process of the same user attacks the goal socket; a client that was there before asks
    for the state."""
    with _attackers(runner, [attack]):
        began = time.monotonic()
        while time.monotonic() - began < stretch_s:
            asked = time.perf_counter()
            await runner.state()
            found.attacked_state_us.append((time.perf_counter() - asked) * 1e6)
            await asyncio.sleep(STOP_PAUSE_S)
        found.attacked.append((began, time.monotonic()))


async def _stops(found: Measured, runner: RunnerClient, count: int) -> None:
    """The last that is measured: the robot stays stopped. First nothing beside, then all attacks at
    once."""
    for stops_us, attacks in ((found.stops_us, ()), (found.attacked_stops_us, WITHOUT_A_SESSION)):
        with _attackers(runner, attacks):
            for _ in range(count):
                stops_us.append(await asyncio.to_thread(_stop, path_of(runner.endpoint)))
                await asyncio.sleep(STOP_PAUSE_S)


def _stop(path: str) -> float:
    """Microseconds until the stop is latched, the connection included."""
    with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as button:
        began = time.perf_counter()
        button.connect(path)
        button.send(request("bench"))
        reply = reply_in(button.recv(REPLY_MAX_BYTES))
        took_us = (time.perf_counter() - began) * 1e6
    if reply.answer not in (Answer.LATCHED, Answer.ALREADY):
        raise RuntimeError(f"the runner did not stop: {reply}")
    return took_us


@contextmanager
def _attackers(runner: RunnerClient, attacks: Sequence[str]) -> Iterator[None]:
    with ExitStack() as stack:
        for attack in attacks:
            stack.enter_context(attacked(runner.endpoint, attack, BOOT_S))
        yield


async def _goal(runner: RunnerClient) -> float:
    began = time.perf_counter()
    goal = await runner.send_goal(GRAB, prompt="grab the red cube", max_ticks=1)
    result = await goal.result(BOOT_S)
    if result["code"] != "limit_exceeded":
        raise RuntimeError(f"the goal ended otherwise than after its one tick: {result}")
    return (time.perf_counter() - began) * 1e6


async def _start_another(
    daemon: ArbiterProcess, others: list["subprocess.Popen[bytes]"]
) -> Stretch:
    """A further sidecar process comes up beside the runner and imports all its libraries."""
    began = time.monotonic()
    with _sidecar(daemon, "third", "so101-grab") as process:
        async with PolicyClient(f"ipc://{daemon.runtime}/third.sock") as client:
            await _until_up(client.ping, [process, *others])
            await client.load(timeout_s=BOOT_S)
        return began, time.monotonic()


# -- programs
async def _until_up(ping: Callable[[], Any], programs: Sequence["subprocess.Popen[bytes]"]) -> None:
    async with asyncio.timeout(BOOT_S):
        while True:
            for program in programs:
                if program.poll() is not None:
                    raise RuntimeError(f"{program.args!r} ended with {program.returncode}")
            try:
                await ping()
                return
            except (SidecarUnavailable, RunnerUnreachable):
                await asyncio.sleep(POLL_S)


@contextmanager
def _sidecar(
    daemon: ArbiterProcess, name: str, skill: str = ""
) -> Iterator["subprocess.Popen[bytes]"]:
    manifest = ROOT / "configs/rskills" / (skill or SKILLS[name]) / "rskill.yaml"
    words = [
        "vram_arbiter.sidecars",
        "--name",
        name,
        "--rskill",
        str(manifest),
        "--device",
        f"fake:{daemon.gpu_folder}",
    ]
    with _program(
        daemon, name, [*words, "--min-residency-s", "0", "--footprint", FOOTPRINT]
    ) as process:
        yield process


@contextmanager
def _program(
    daemon: ArbiterProcess, name: str, words: Sequence[str]
) -> Iterator["subprocess.Popen[bytes]"]:
    """`python -m WORDS` in the daemon's runtime folder. What it said is shown when anything goes
    wrong."""
    log = daemon.runtime / f"{name}.log"
    # as the demo starts them
    environ = daemon.environ | {"HF_HUB_OFFLINE": "1", "OMP_NUM_THREADS": "1"}
    with log.open("ab") as sink:
        process = subprocess.Popen(
            [sys.executable, "-m", *words], cwd=ROOT, env=environ, stdout=sink, stderr=sink
        )
    try:
        yield process
    except BaseException:
        print(f"{name}:\n{log.read_text(errors='replace')[-3000:]}", file=sys.stderr)
        raise
    finally:
        process.terminate()
        try:
            process.wait(END_S)
        except subprocess.TimeoutExpired:
            process.kill()
            process.wait()
