"""Run a program under observation: a thread reads the GPU, the program goes through its phases.

Bytes are those of the program's process tree where the driver lists bytes by process, else the
growth of the GPU's used bytes on a GPU that is otherwise at rest.
"""

import asyncio
import contextlib
import os
import signal
import sys
import tempfile
import threading
import time
from collections.abc import AsyncIterator, Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.clients.calibration.gpu import Gpu, Reading
from vram_arbiter.clients.calibration.requests import asking, client_type
from vram_arbiter.clients.calibration.series import REST_BYTES, Figures, Series, of_life
from vram_arbiter.clients.sidecar.spawn import SpawnSpec
from vram_arbiter.schemas.defaults import VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import CalibrationFailed, ProbeFailed, VramError
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.sizes import format_bytes

CONTEXT = (sys.executable, "-m", "vram_arbiter.clients.calibration.context")
SIDECAR = (sys.executable, "-m", "vram_arbiter.sidecars")
START_S = 60.0
LOAD_S = 1800.0
"""A large model from a cold disk."""
GRACE_S = 10.0
TAIL_BYTES = 4000
TAIL_LINES = 20


@dataclass(frozen=True, slots=True)
class Pace:
    """How often the GPU is read, and how long bytes must be unchanged to be at rest.

    `rest_s` is longer than drivers take to return memory (0.5 to 1.5 s). What is not at rest within
    `limit_s` more never is.
    """

    rate_hz: float = 50.0
    rest_s: float = 2.0
    limit_s: float = VERIFY_TIMEOUT_S

    @property
    def period_s(self) -> float:
        return 1 / self.rate_hz


@dataclass(frozen=True, slots=True)
class Basis:
    """What can be seen on this GPU. `listed`: bytes by process; else `baseline_bytes` are in use
    without the program."""

    listed: bool
    context_bytes: int
    baseline_bytes: int


class OwnBytes:
    """Bytes of the process tree below this process at each call. A process that was in the tree
    stays in it when its parent ends."""

    def __init__(self, gpu: Gpu, basis: Basis) -> None:
        self._root = os.getpid()
        self._gpu = gpu
        self._basis = basis
        self._seen: set[tuple[int, int]] = set()

    def __call__(self) -> int:
        reading = self._gpu.read()
        if not self._basis.listed:
            return max(0, reading.used_bytes - self._basis.baseline_bytes)
        if reading.processes is None:
            raise ProbeFailed(
                "the driver stopped listing processes in the middle of the measurement",
                hint="see nvidia-smi and dmesg",
            )
        return sum(count for pid, count in reading.processes.items() if self._is_ours(pid))

    def _is_ours(self, pid: int) -> bool:
        stat = procfs.read_stat(pid)
        if stat is None:
            return False
        key, parent = (pid, stat.start_ticks), stat.parent_pid
        while key not in self._seen and parent > 1:
            if parent == self._root:
                self._seen.add(key)
                break
            above = procfs.read_stat(parent)
            parent = 0 if above is None else above.parent_pid
        return key in self._seen


class Sampler:
    """Series of readings, made by a thread. `step` makes one."""

    def __init__(
        self,
        read: Callable[[], int],
        period_s: float,
        clock: Callable[[], float] = time.monotonic,
    ) -> None:
        self.series = Series()
        self.clock = clock
        self._read = read
        self._period_s = period_s
        self._error: VramError | None = None
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="readings", daemon=True)

    def __enter__(self) -> "Sampler":
        self.step()
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._over.set()
        self._thread.join(VERIFY_TIMEOUT_S)  # a driver may hang

    def step(self) -> None:
        """Make one reading. The time is that of its end: bytes are never dated before a mark that
        they follow."""
        count = self._read()
        self.series.add(self.clock(), count)

    def check(self) -> None:
        """Raise what ended the readings."""
        if self._error is not None:
            raise self._error

    def _run(self) -> None:
        due_s = self.clock()
        while True:
            due_s = max(due_s + self._period_s, self.clock())
            if self._over.wait(max(0.0, due_s - self.clock())):
                return
            try:
                self.step()
            except VramError as error:
                self._error = error
                return


# -- what can be seen here
async def find_basis(gpu: Gpu, pace: Pace) -> Basis:
    """Measure an empty context, and learn from it what the driver lists.

    Raises CalibrationFailed where neither the list nor the total can tell the program's bytes.
    """
    async with _context(gpu) as pid:
        listed = await _rest(lambda: _listed(gpu.read(), pid), pace)
    if listed:
        return Basis(listed=True, context_bytes=listed, baseline_bytes=0)
    baseline = await _used_at_rest(gpu, pace)
    async with _context(gpu):
        used = await _used_at_rest(gpu, pace)
    await _returned(gpu, baseline, pace)
    return Basis(listed=False, context_bytes=max(0, used - baseline), baseline_bytes=baseline)


@contextlib.asynccontextmanager
async def _context(gpu: Gpu) -> AsyncIterator[int]:
    """An empty context on the GPU; gives the pid of its process. Raises CalibrationFailed."""
    process = await asyncio.create_subprocess_exec(
        *CONTEXT, gpu.device,
        env={**os.environ, **gpu.environ}, start_new_session=True,
        stdin=asyncio.subprocess.PIPE, stdout=asyncio.subprocess.PIPE,
        stderr=asyncio.subprocess.PIPE,
    )  # fmt: skip
    assert process.stdin is not None, "a pipe"
    assert process.stdout is not None, "a pipe"
    assert process.stderr is not None, "a pipe"
    try:
        try:
            first = await asyncio.wait_for(process.stdout.readline(), START_S)
        except TimeoutError:
            raise CalibrationFailed(
                f"creating a context on {gpu.name} took more than {START_S:.0f} s",
                hint="see nvidia-smi and dmesg",
            ) from None
        if first != b"ready\n":
            said = (await process.stderr.read()).decode(errors="replace").strip()
            raise CalibrationFailed(
                f"no context can be created on {gpu.name}: {said}",
                hint="check that CUDA programs run on it; see nvidia-smi",
            )
        yield process.pid
        process.stdin.close()
        await process.wait()
    finally:
        if process.returncode is None:
            process.kill()
            await process.wait()


def _listed(reading: Reading, pid: int) -> int:
    return (reading.processes or {}).get(pid, 0)


async def _used_at_rest(gpu: Gpu, pace: Pace) -> int:
    found = await _rest(lambda: gpu.read().used_bytes, pace)
    if found is None:
        raise CalibrationFailed(
            f"{gpu.name} is in use by other programs, and the driver does not list bytes by process"
            " here",
            hint="end those programs, or measure outside the container",
        )
    return found


async def _returned(gpu: Gpu, baseline_bytes: int, pace: Pace) -> None:
    """Wait until the used bytes are back where they were. Raises CalibrationFailed: then others
    used the GPU meanwhile."""
    most = baseline_bytes + VERIFY_TOLERANCE_BYTES
    deadline_s = time.monotonic() + pace.limit_s
    while True:
        used = gpu.read().used_bytes
        if used <= most or time.monotonic() > deadline_s:
            break
        await asyncio.sleep(pace.period_s)
    if abs(used - baseline_bytes) > VERIFY_TOLERANCE_BYTES:
        raise CalibrationFailed(
            f"{format_bytes(used)} are in use on {gpu.name} after the measurement, "
            f"{format_bytes(baseline_bytes)} were before: another program used it meanwhile",
            hint="the driver does not list bytes by process here, so nothing else may use the GPU",
        )


async def _rest(read: Callable[[], int], pace: Pace) -> int | None:
    """Return a value that has not changed for `rest_s`; None: it does not come to rest."""
    series = Series()
    deadline_s = time.monotonic() + pace.rest_s + pace.limit_s
    while time.monotonic() < deadline_s:
        series.add(time.monotonic(), read())
        if series.rested_s() >= pace.rest_s:
            return series.last
        await asyncio.sleep(pace.period_s)
    return None


# -- programs
@dataclass(frozen=True, slots=True)
class Measured:
    """Figures, and how they were made."""

    figures: Figures
    basis: Basis
    rate_hz: float
    requests: int


async def measure_program(
    gpu: Gpu, pace: Pace, command: Sequence[str], seconds: float | None, say: Callable[[str], None]
) -> Measured:
    """Observe a program from its start to its end; after `seconds` it is ended.

    Raises CalibrationFailed with its exit code and last lines where it fails, or without any bytes.
    """
    basis = await find_basis(gpu, pace)
    say(f"an empty context has {format_bytes(basis.context_bytes)}; starting {command[0]}")
    with Sampler(OwnBytes(gpu, basis), pace.period_s) as sampler:
        program = await _Program.start(command, {**os.environ, **gpu.environ})
        try:
            async with asyncio.timeout(seconds):
                await program.ended()
        except TimeoutError:
            say(f"ending it after {seconds:g} s")
        else:
            program.check()
        finally:
            await program.end()
        after = await _settled(sampler, pace, gone=True)
    if not basis.listed:
        await _returned(gpu, basis.baseline_bytes, pace)
    figures = of_life(sampler.series, basis.context_bytes, after)
    if figures is None:
        raise _no_bytes(gpu, command[0], program.tail())
    return Measured(figures, basis, sampler.series.rate_hz, 0)


@dataclass(frozen=True, slots=True)
class Asked:
    """What a model is asked. `pictures`: a folder of them (None: noise); `prompt`: in words (None:
    the manifest's)."""

    requests: int
    pictures: Path | None = None
    prompt: str | None = None


async def measure_model(
    gpu: Gpu,
    pace: Pace,
    manifest: RSkillManifest,
    arguments: Sequence[str],
    asked: Asked,
    say: Callable[[str], None],
    sidecar: Sequence[str] = SIDECAR,
) -> Measured:
    """Load a model in a sidecar of its own, ask it, unload it and end it.

    `sidecar` is its command, and `arguments` name the model for it. Raises the sidecar's typed
    errors, CalibrationFailed and ProbeFailed.
    """
    client_for = client_type(manifest)
    with tempfile.TemporaryDirectory(prefix="vc") as folder:
        endpoint = f"ipc://{folder}/calibrate.sock"
        argv = [
            *sidecar, "--name", "calibrate", "--no-arbiter", "--device", gpu.device,
            "--endpoint", endpoint, *arguments,
        ]  # fmt: skip
        spawn = SpawnSpec(argv, dict(gpu.environ), Path(folder) / "log")
        client = client_for(endpoint, spawn=spawn, timeout_s=LOAD_S)
        ask = asking(client, manifest, asked.pictures, asked.prompt)
        basis = await find_basis(gpu, pace)
        say(f"an empty context has {format_bytes(basis.context_bytes)}; loading {manifest.name}")
        with Sampler(OwnBytes(gpu, basis), pace.period_s) as sampler:
            try:
                await client.load()
                steady = await _settled(sampler, pace)
                if steady <= REST_BYTES:
                    raise _no_bytes(gpu, manifest.name, "")
                asked_s = sampler.clock()
                load_peak = sampler.series.peak(0.0, asked_s)
                say(f"resident with {format_bytes(steady)}; asking {asked.requests} times")
                for _ in range(asked.requests):
                    await ask()
                    sampler.check()
                await asyncio.sleep(2 * pace.period_s)  # a reading after the last answer
                inference_peak = sampler.series.peak(asked_s, sampler.clock())
                await client.unload()
                retained = await _settled(sampler, pace, gone=True)
                say(f"unloaded; {format_bytes(retained)} are left")
            finally:
                await client.close()
            after = await _settled(sampler, pace, gone=True)
    if not basis.listed:
        await _returned(gpu, basis.baseline_bytes, pace)
    figures = Figures(
        context=basis.context_bytes,
        load_peak=load_peak,
        steady=steady,
        inference_peak=inference_peak if asked.requests else None,
        retained=retained,
        after_exit=after,
    )
    return Measured(figures, basis, sampler.series.rate_hz, asked.requests)


async def _settled(sampler: Sampler, pace: Pace, *, gone: bool = False) -> int:
    """Return the program's bytes once they are at rest; `gone`: or all gone. Raises
    CalibrationFailed."""
    since_s = sampler.clock()
    deadline_s = since_s + pace.rest_s + pace.limit_s
    while (now_s := sampler.clock()) < deadline_s:
        sampler.check()
        series = sampler.series
        fresh = series.end_s > since_s
        rested = min(series.rested_s(), now_s - since_s) >= pace.rest_s
        if fresh and (rested or (gone and series.last <= REST_BYTES)):
            return series.last
        await asyncio.sleep(pace.period_s)
    raise CalibrationFailed(
        f"the program's bytes did not come to rest within {deadline_s - since_s:.0f} s",
        hint="does it work in the background? measure it with: vramctl calibrate -- COMMAND",
    )


def _no_bytes(gpu: Gpu, name: str, tail: str) -> CalibrationFailed:
    return CalibrationFailed(
        f"no bytes of {name} were seen on {gpu.name} ({gpu.uuid})",
        hint="does it run on the CPU, or on another GPU? see --device",
        details={"log": tail},
    )


class _Program:
    """A program in a session of its own; its output goes to stderr, and its end is kept."""

    def __init__(self, process: asyncio.subprocess.Process, name: str) -> None:
        self._process = process
        self._name = name
        self._kept = b""
        self._reading = asyncio.create_task(self._pass_on(), name="output")

    @classmethod
    async def start(cls, command: Sequence[str], environ: Mapping[str, str]) -> "_Program":
        try:
            process = await asyncio.create_subprocess_exec(
                *command, env=environ, start_new_session=True,
                stdout=asyncio.subprocess.PIPE, stderr=asyncio.subprocess.STDOUT,
            )  # fmt: skip
        except OSError as error:
            raise CalibrationFailed(
                f"cannot start {command[0]}: {error.strerror}", hint="check the command"
            ) from error
        return cls(process, command[0])

    @property
    def pid(self) -> int:
        return self._process.pid

    async def ended(self) -> None:
        await self._process.wait()

    def check(self) -> None:
        """Raise CalibrationFailed for a program that ended by itself with a failure."""
        code = self._process.returncode
        if code:
            how = f"exit code {code}" if code > 0 else signal.Signals(-code).name
            raise CalibrationFailed(
                f"{self._name} ended with {how}; its last lines:\n{self.tail()}",
                hint="it has to run to its end, or use --seconds",
                details={"exit_code": code, "log": self.tail()},
            )

    async def end(self) -> None:
        """End the whole session: SIGTERM, then SIGKILL."""
        for number, grace_s in ((signal.SIGTERM, GRACE_S), (signal.SIGKILL, GRACE_S)):
            if self._process.returncode is not None:
                break
            with contextlib.suppress(ProcessLookupError):
                os.killpg(self.pid, number)
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._process.wait(), grace_s)
        await asyncio.wait({self._reading}, timeout=0.5)  # a child may keep the pipe open
        self._reading.cancel()

    def tail(self) -> str:
        lines = self._kept.decode(errors="replace").splitlines()
        return "\n".join(lines[-TAIL_LINES:])

    async def _pass_on(self) -> None:
        assert self._process.stdout is not None, "it is a pipe"
        while piece := await self._process.stdout.read(1 << 16):
            sys.stderr.write(piece.decode(errors="replace"))
            sys.stderr.flush()
            self._kept = (self._kept + piece)[-TAIL_BYTES:]
