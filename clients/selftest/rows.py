"""Rows of a self-test: each is a function that measures one claim of the product about a GPU, with
its limit and the source of that."""

import asyncio
import math
import os
import statistics
import time
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass
from functools import wraps
from pathlib import Path
from signal import SIGKILL
from typing import Any, Final

from vram_arbiter.clients.calibration.model import observation_of
from vram_arbiter.clients.configs import configs_folder
from vram_arbiter.clients.foreign.actions import Action
from vram_arbiter.clients.foreign.cuda_checkpoint import CheckpointAction, CudaDriver
from vram_arbiter.clients.foreign.program import below, is_below
from vram_arbiter.clients.selftest.bed import (
    MODEL_S,
    Bed,
    Missed,
    ask,
)
from vram_arbiter.schemas import defaults as d
from vram_arbiter.schemas.defaults import MIB, VERIFY_TIMEOUT_S, VERIFY_TOLERANCE_BYTES
from vram_arbiter.schemas.errors import VramError, WaitTimeout
from vram_arbiter.schemas.manifest import RSkillManifest
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.threads import answered_within
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

type Found = tuple[float, str]
"""A figure in the row's unit, and a remark."""
type Measure = Callable[[Bed], Awaitable[Found]]

DETECTOR, VLM, POLICY = "so101-detector", "so101-scene-vlm", "so101-grab"
READINGS: Final = 20
ASKING_S: Final = 1.0
"""How long a request waits beside a stowaway: several readings."""
CUBE: Final = "diagnostics/cube.png"
"""A red cube on a table, drawn: of the configs."""
CUBE_PX, CUBE_SIDE_PX = (326, 243), 40
BEAT_S: Final = 0.05
CHECKPOINT_S: Final = 20.0
ROW_S: Final = 40.0
"""The first row may read torch from a cold disk."""
UVM: Final = "/dev/nvidia-uvm"
"""Device file of CUDA's unified memory: `cuInit` opens it, and reading by NVML does not."""
VERIFY: Final = {"source": "verify.timeout_s", "most": VERIFY_TIMEOUT_S * 1000}
TOLERANCE: Final = {"source": "verify.tolerance_bytes", "most": VERIFY_TOLERANCE_BYTES / MIB}


@dataclass(frozen=True, slots=True)
class Claim:
    """What a row measures. Its figure is to be `most` at the most, or `least` at the least, by
    `source`.

    `hardware`: cannot run on a simulated GPU. `skill`: whose sidecar it needs. `timed_model`: on a
    simulated GPU the figure is the CPU's, and has no limit.
    """

    id: str
    what: str
    measure: Measure
    unit: str
    source: str
    most: float = float("inf")
    least: float = float("-inf")
    hardware: bool = False
    skill: str = ""
    timed_model: bool = False
    limit_s: float = ROW_S

    @property
    def limit(self) -> str:
        bound = f"≥ {self.least:g}" if self.most == float("inf") else f"≤ {self.most:g}"
        return f"{bound} {self.unit}".rstrip()


ROWS: Final[list[Claim]] = []
"""In the order in which they are measured."""


def row(unit: str, **fields: Any) -> Callable[[Measure], Measure]:
    """Make a row of a function: its name is the id, and its docstring says what it measures."""

    def made(measure: Measure) -> Measure:
        what = (measure.__doc__ or "").partition(".")[0].removeprefix("Measure the ")
        name = measure.__name__.replace("_", "-")
        ROWS.append(Claim(name, what, measure, unit, **fields))
        return measure

    return made


# -- the driver
@row("ms", source="probe.load_s", most=d.LOAD_PROBE_S * 1000)
async def reading(bed: Bed) -> Found:
    """Measure the median time of a reading."""
    taken = [await _timed(bed.read()) for _ in range(READINGS)]
    listed = taken[-1][0].processes is not None
    named = "bytes by process are listed" if listed else "no bytes by process"
    return statistics.median(ms for _, ms in taken), named


async def _timed[T](work: Awaitable[T]) -> tuple[T, float]:
    """Return what the work returns, and its time in ms."""
    began_s = time.perf_counter()
    return await work, (time.perf_counter() - began_s) * 1000


@row("MiB", source="limits.md: 0.1 to 0.6 GB", most=572)
async def context(bed: Bed) -> Found:
    """Measure the bytes of a process that has only touched the GPU."""
    async with bed.holder() as holder:
        before = await bed.used()
        await ask(holder, "fill", 0)
        now = await bed.read()
        named = (now.processes or {}).get(holder.process.pid)
        remark = "its pid is not listed" if named is None else f"listed: {named / MIB:.0f} MiB"
        return (now.used_bytes - before) / MIB, remark


@row("ms", **VERIFY)
async def lag_free(bed: Bed) -> Found:
    """Measure the time from a free to a reading that shows it."""
    async with bed.holder(size_bytes=0) as holder:
        empty = await bed.used()
        await ask(holder, "fill", bed.part_bytes)
        shown = await bed.used() - empty
        if shown < bed.part_bytes - VERIFY_TOLERANCE_BYTES:
            raise Missed(f"{shown / MIB:.0f} MiB of {bed.part_bytes / MIB:.0f} are seen")
        await ask(holder, "free")
        return await bed.returned(empty) * 1000, "the context stays"


@row("ms", **VERIFY)
async def lag_exit(bed: Bed) -> Found:
    """Measure the time from a process's end to a reading that shows it."""
    before = await bed.used()
    async with bed.holder(size_bytes=bed.part_bytes) as holder:
        await bed.programs.stop(holder.name)
        return await bed.returned(before) * 1000, "context and weights"


@row("times", source="performance.md", most=2, hardware=True)
async def restore(bed: Bed) -> Found:
    """Measure the time of a restore, in times of one cudaMemcpy."""
    ours, plain = await _rates(bed, "restore", "pageable")
    return plain / ours, f"{ours:.1f} GB/s, cudaMemcpy {plain:.1f} GB/s"


@row("times", source="CUDA C++ Best Practices: pinned memory", least=1, hardware=True)
async def page_locked(bed: Bed) -> Found:
    """Measure the speed of page-locked memory, in times of pageable."""
    locked, plain = await _rates(bed, "page_locked", "pageable")
    return locked / plain, f"{locked:.1f} GB/s, pageable {plain:.1f} GB/s"


async def _rates(bed: Bed, *copies: str) -> list[float]:
    """Return GB/s of copies, which are timed once for both of their rows."""
    if not bed.copies:
        async with bed.holder() as holder:
            bed.copies = await ask(holder, "copies", bed.memory_bytes // 8)
    return [bed.copies[name] for name in copies]


@row("", source="the CPU's answer", most=1e-3, hardware=True)
async def nf4(bed: Bed) -> Found:
    """Measure the relative difference of NF4 on GPU and CPU."""
    need("the row", "torch", "bitsandbytes", extra="sidecars")
    async with bed.holder() as holder:
        told = await ask(holder, "nf4")
    if told["bytes"] * 8 != told["of_bytes"]:
        raise Missed(f"{told['of_bytes']} bytes became {told['bytes']}, not an eighth")
    return told["difference"], "an eighth of float32"


@row("MiB", **TOLERANCE, hardware=True, limit_s=2 * ROW_S)
async def checkpoint(bed: Bed, action: Action | None = None) -> Found:
    """Measure the bytes of a suspended process, which then continues with its numbers."""
    action = action or CheckpointAction(CudaDriver(), CHECKPOINT_S)
    await answered_within(CHECKPOINT_S, action.check)
    before = await bed.used()
    # torch can share its expandable segments with processes, and shared memory stays (IPC)
    async with bed.holder(PYTORCH_CUDA_ALLOC_CONF="expandable_segments:False") as holder:
        numbers, pids = await ask(holder, "sum", bed.part_bytes), [holder.process.pid]
        _, gone_ms = await _timed(answered_within(CHECKPOINT_S, lambda: action.free(pids)))
        await bed.returned(before)
        left = await bed.used() - before
        _, back_ms = await _timed(answered_within(CHECKPOINT_S, lambda: action.restore(pids)))
        if await ask(holder, "sum", bed.part_bytes) != numbers:
            raise Missed("the process continued with other numbers")
    return left / MIB, f"suspended in {gone_ms / 1000:.2f} s, resumed in {back_ms / 1000:.2f} s"


# -- the arbiter
@row("ms", **VERIFY)
async def evict(bed: Bed) -> Found:
    """Measure the time from an evicted holder's release to its verdict, before the next grant."""
    async with bed.holder("victim", bed.part_bytes), bed.holder("next", bed.part_bytes):
        events = (await bed.client.history(kinds=("verified",))).events
    event = next(one for one in events if one["consumer"] == "victim")
    if event["verdict"] != "verified":
        raise Missed(f"the verdict is {event['verdict']}")
    return event["ms"], "verified"


@row("MiB", source="limits.md", least=1)
async def stowaway(bed: Bed) -> Found:
    """Measure the bytes of a stowaway that the daemon sees, while it grants nothing."""
    async with bed.holder(size_bytes=bed.part_bytes):
        await asyncio.sleep(d.SAMPLE_MAX_AGE_S)  # so long a reading from before it counts
        try:
            async with bed.client.lease(_all(bed), ASKING_S):
                raise Missed("the GPU was leased beside a process without a lease")
        except WaitTimeout:
            (view,) = [one for one in (await bed.client.status()).gpus if one.gpu == bed.gpu.uuid]
    async with bed.client.lease(_all(bed), VERIFY_TIMEOUT_S):
        return view.stowaway_bytes / MIB, "granted once it had ended"


def _all(bed: Bed) -> LeaseSpec:
    """Return a lease of all that the daemon has, by this process, that retains nothing."""
    footprint = Footprint(bed.lease_bytes, bed.lease_bytes, residue_bytes=0)
    return LeaseSpec("selftest", "selftest", footprint, gpu=bed.gpu.uuid)


@row("ms", **VERIFY)
async def kill_holder(bed: Bed) -> Found:
    """Measure the time from a holder's SIGKILL to the grant of its bytes."""
    async with bed.holder("killed", bed.part_bytes) as holder:
        began_s = time.monotonic()
        await bed.programs.stop(holder.name, SIGKILL)
        async with bed.client.lease(_all(bed), VERIFY_TIMEOUT_S):
            return (time.monotonic() - began_s) * 1000, "and measured back"


@row("s", source="lease.ttl_s + lease.fence_grace_s", most=d.LEASE_TTL_S + d.FENCE_GRACE_S)
async def kill_daemon(bed: Bed) -> Found:
    """Measure the time from the daemon's SIGKILL until its successor knows the holder."""
    async with bed.holder("kept", bed.part_bytes):
        lease, used, began_s = await _held(bed), await bed.used(), time.monotonic()
        await bed.programs.restart("arbiter", SIGKILL)
        if await _held(bed) != lease:
            raise Missed("the lease is another one")
        seconds = time.monotonic() - began_s
        if (moved := abs(await bed.used() - used)) > VERIFY_TOLERANCE_BYTES:
            raise Missed(f"{moved / MIB:.0f} MiB changed on the GPU")
        return seconds, "the same lease, its bytes untouched"


async def _held(bed: Bed) -> str:
    """Wait until a daemon answers that a lease is held. Return the id."""
    while True:
        with suppress(VramError):
            for one in (await bed.client.status()).leases:
                if one.state == "held":
                    return one.lease_id
        await asyncio.sleep(BEAT_S)


# -- models
@row("processes", source="limits.md", most=0, skill=POLICY, limit_s=MODEL_S + ROW_S)
async def fork_server(bed: Bed) -> Found:
    """Measure the processes of daemon and sidecars with a context, beside the model's."""
    async with bed.model(POLICY):
        tree = below(os.getpid())
        listed = (await bed.read()).processes or {}  # in a container: pids of the host
        holding = [pid for pid in tree if (pid in listed if bed.simulated else _opened_uvm(pid))]
    if not holding:
        raise Missed("no process of the sidecar has a context")
    return len(holding) - 1, f"of {len(tree)} processes"


def _opened_uvm(pid: int) -> bool:
    try:
        return any(os.readlink(one) == UVM for one in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:  # a file was closed meanwhile, or the process has ended
        return False


type Question = Callable[[Any, RSkillManifest], Awaitable[None]]
"""Asks the client of a model, and judges its answer. Raises Missed."""


def _model(skill: str, budget_ms: float) -> Callable[[Question], Measure]:
    """Make a row of a question to a model; its limit is the manifest's."""
    fields = {"source": f"latency_budget of {skill}", "most": budget_ms, "timed_model": True}

    def made(question: Question) -> Measure:
        @row("ms", **fields, limit_s=MODEL_S + ROW_S, skill=skill)
        @wraps(question)
        async def measure(bed: Bed) -> Found:
            before = await bed.used()
            async with bed.model(skill) as asked:
                await question(*asked)  # the first one loads its kernels
                _, ms = await _timed(question(*asked))
                return ms, f"resident in {(await bed.used() - before) / MIB:.0f} MiB"

        return measure

    return made


@_model(DETECTOR, 1000)
async def detector(client: Any, manifest: RSkillManifest) -> None:
    """Measure the time in which a detector finds a drawn cube."""
    found = await client.detect(_cube(), "red cube")
    if not found or math.dist(found[0].centre, CUBE_PX) > CUBE_SIDE_PX / 2:
        raise Missed(f"expected the cube at {CUBE_PX}, found {found[:1]}")


@_model(VLM, 3000)
async def vlm(client: Any, manifest: RSkillManifest) -> None:
    """Measure the time in which a scene VLM answers about it."""
    said = await client.query(_cube(), "Has the robot gripper grasped the red cube?")
    if not said.startswith("No"):
        raise Missed(f"the drawn cube lies on a table, and the answer is {said!r}")


@_model(POLICY, 400)
async def policy(client: Any, manifest: RSkillManifest) -> None:
    """Measure the time in which a policy answers to noise."""
    actions = await client.get_action(observation_of(manifest))
    if not all(map(math.isfinite, actions["action"].ravel())):
        raise Missed("its actions are not finite")


def _cube() -> bytes:
    return (configs_folder(os.environ) / CUBE).read_bytes()


# -- the end
@row("MiB", **TOLERANCE)
async def left_as_found(bed: Bed) -> Found:
    """Measure the bytes that are used beside those of before, once all children have ended."""
    await bed.programs.stop_all()
    with suppress(Missed):  # the figure says so
        await bed.returned(bed.found.used_bytes)
    now = await bed.read()
    if own := [pid for pid in now.processes or () if is_below(pid, os.getpid())]:
        raise Missed(f"processes of this test are on the GPU: {own}")
    counts = f"{len(bed.found.processes or ())} processes before, {len(now.processes or ())} now"
    return (now.used_bytes - bed.found.used_bytes) / MIB, counts


LAST: Final = ROWS.pop()
