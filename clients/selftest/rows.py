"""Rows of a self-test: each claim of the product about a GPU, its limit with the source of that,
and the function that measures it."""

import asyncio
import os
import statistics
import time
from collections.abc import Awaitable, Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Final

from vram_arbiter.clients.calibration.model import ASKED
from vram_arbiter.clients.foreign.actions import Action
from vram_arbiter.clients.foreign.cuda_checkpoint import CheckpointAction, CudaDriver
from vram_arbiter.clients.foreign.program import is_below
from vram_arbiter.clients.selftest.bed import MODEL_S, Bed, Missed, Skipped, in_thread, need
from vram_arbiter.schemas.defaults import (
    FENCE_GRACE_S,
    LEASE_TTL_S,
    LOAD_PROBE_S,
    MIB,
    SAMPLE_MAX_AGE_S,
    VERIFY_TIMEOUT_S,
    VERIFY_TOLERANCE_BYTES,
)
from vram_arbiter.schemas.errors import CheckpointUnsupported, VramError, WaitTimeout
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

type Found = tuple[float, str]
"""A figure in the row's unit, and a remark."""

DETECTOR, VLM, POLICY = "so101-detector", "so101-scene-vlm", "so101-grab"
READINGS: Final = 20
ASKING_S: Final = 1.0
"""How long a request waits beside a stowaway: several readings."""
BEAT_S: Final = 0.05
CHECKPOINT_S: Final = 20.0
UVM: Final = "/dev/nvidia-uvm"
"""Device file of CUDA's unified memory: `cuInit` opens it, and reading by NVML does not."""
VERIFY: Final = "verify.timeout_s"
TOLERANCE_MIB: Final = VERIFY_TOLERANCE_BYTES / MIB


@dataclass(frozen=True, slots=True)
class Row:
    """One claim. The figure is to be `most` at the most, or `least` at the least, by `source`.

    `hardware`: cannot run on a simulated GPU. `skill`: whose sidecar it needs.
    """

    id: str
    what: str
    unit: str
    measure: Callable[[Bed], Awaitable[Found]]
    source: str
    most: float | None = None
    least: float | None = None
    hardware: bool = False
    skill: str = ""
    limit_s: float = 30.0

    @property
    def timed_model(self) -> bool:
        """Whether the figure is the CPU's on a simulated GPU."""
        return bool(self.skill) and self.unit == "ms"

    @property
    def limit(self) -> str:
        sign, bound = ("≤", self.most) if self.most is not None else ("≥", self.least)
        return f"{sign} {bound:g} {self.unit}".rstrip()

    def holds(self, figure: float) -> bool:
        """Return whether a figure is within the limit."""
        return (self.most is None or figure <= self.most) and (
            self.least is None or figure >= self.least
        )


# -- the driver
async def reading(bed: Bed) -> Found:
    """Median milliseconds of a reading."""
    times = []
    for _ in range(READINGS):
        began_s = time.perf_counter()
        listed = (await bed.read()).processes
        times.append((time.perf_counter() - began_s) * 1000)
    named = "bytes by process are listed" if listed is not None else "no bytes by process"
    return statistics.median(times), named


async def context(bed: Bed) -> Found:
    """MiB that a process takes by touching the GPU."""
    async with bed.holder() as holder:
        before = await bed.used()
        await holder.ask("touch")
        reading = await bed.read()
        named = (reading.processes or {}).get(holder.pid)
        remark = (
            "not in the list of processes" if named is None else f"listed: {named / MIB:.0f} MiB"
        )
        return (reading.used_bytes - before) / MIB, remark


async def lag_free(bed: Bed) -> Found:
    """Milliseconds from a free to its bytes in a reading."""
    async with bed.holder() as holder:
        await holder.ask("touch")
        empty = await bed.used()
        await holder.ask("fill", bed.part_bytes)
        filled = await bed.used()
        if filled - empty < bed.part_bytes - VERIFY_TOLERANCE_BYTES:
            raise Missed(f"{(filled - empty) / MIB:.0f} MiB of {bed.part_bytes / MIB:.0f} are seen")
        await holder.ask("free")
        return await bed.returned(empty) * 1000, "the context stays"


async def lag_exit(bed: Bed) -> Found:
    """Milliseconds from the end of a process to its bytes in a reading."""
    before = await bed.used()
    async with bed.holder() as holder:
        await holder.ask("fill", bed.part_bytes)
        await holder.end()
        return await bed.returned(before) * 1000, "context and weights"


async def _copies(bed: Bed) -> None:
    """Time the copies, once for both of their rows."""
    if not bed.copies:
        async with bed.holder() as holder:
            bed.copies = await holder.ask("copies", bed.memory_bytes // 8)


def _rate(bed: Bed, name: str) -> float:
    """Return GB/s of a copy."""
    return float(bed.copies["bytes"] / bed.copies[name] / 1e9)


async def restore(bed: Bed) -> Found:
    """Time of a restore by that of one cudaMemcpy of the same bytes."""
    await _copies(bed)
    ours, plain = _rate(bed, "restore_s"), _rate(bed, "pageable_s")
    return plain / ours, f"{ours:.1f} GB/s, cudaMemcpy {plain:.1f} GB/s"


async def page_locked(bed: Bed) -> Found:
    """Rate of a copy from page-locked memory by that from pageable memory."""
    await _copies(bed)
    locked, plain = _rate(bed, "page_locked_s"), _rate(bed, "pageable_s")
    return locked / plain, f"{locked:.1f} GB/s, pageable {plain:.1f} GB/s"


async def nf4(bed: Bed) -> Found:
    """Relative error of a network in NF4 on the GPU, beside the same bytes on the CPU."""
    need("torch", "bitsandbytes", extra="sidecars")
    async with bed.holder() as holder:
        told = await holder.ask("nf4")
    if told["bytes"] * 8 != told["of_bytes"]:
        raise Missed(f"{told['of_bytes']} bytes became {told['bytes']}, not an eighth")
    return told["difference"], "an eighth of float32"


async def checkpoint(bed: Bed, action: Action | None = None) -> Found:
    """MiB that a suspended process leaves on the GPU; it continues with the same numbers."""
    action = action or CheckpointAction(CudaDriver(), CHECKPOINT_S)
    try:
        await in_thread(action.check, CHECKPOINT_S)
    except CheckpointUnsupported as error:
        raise Skipped(f"{error.message}; {error.hint}") from None
    before = await bed.used()
    # torch can share its expandable segments with processes, and shared memory stays (IPC)
    plain = {"PYTORCH_CUDA_ALLOC_CONF": "expandable_segments:False"}
    async with bed.holder(environ=plain) as holder:
        numbers = await holder.ask("number", bed.part_bytes)
        began_s = time.monotonic()
        await in_thread(lambda: action.free([holder.pid]), CHECKPOINT_S)
        gone_s = time.monotonic() - began_s
        await bed.returned(before)
        left = await bed.used() - before
        began_s = time.monotonic()
        await in_thread(lambda: action.restore([holder.pid]), CHECKPOINT_S)
        back_s = time.monotonic() - began_s
        if await holder.ask("sum") != numbers:
            raise Missed("the process continued with other numbers")
    return left / MIB, f"suspended in {gone_s:.2f} s, resumed in {back_s:.2f} s"


# -- the arbiter
def _all(bed: Bed) -> LeaseSpec:
    """Return a lease of all that the daemon has, by this process, that retains nothing."""
    size = bed.lease_bytes
    footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=0)
    return LeaseSpec("selftest", "selftest", footprint, gpu=bed.gpu.uuid)


async def evict(bed: Bed) -> Found:
    """Milliseconds from a release to its verdict, of the victim of another process's request."""
    async with bed.holder("victim") as victim:
        await victim.ask("fill", bed.part_bytes)
        async with bed.holder("next") as following:
            await following.ask("fill", bed.part_bytes)
            events = (await bed.client.history(kinds=("verified",))).events
            event = next(one for one in events if one["consumer"] == "victim")
            if event["verdict"] != "verified":
                raise Missed(f"the verdict is {event['verdict']}")
            return event["ms"], "the next one was granted after it"


async def stowaway(bed: Bed) -> Found:
    """MiB of a process without a lease that the daemon counts while it grants nothing."""
    async with bed.holder() as holder:
        await holder.ask("fill", bed.part_bytes)
        await asyncio.sleep(SAMPLE_MAX_AGE_S)  # so long a reading from before it counts
        try:
            async with bed.client.lease(_all(bed), ASKING_S):
                raise Missed("the GPU was leased beside a process without a lease")
        except WaitTimeout:
            (view,) = [one for one in (await bed.client.status()).gpus if one.gpu == bed.gpu.uuid]
    async with bed.client.lease(_all(bed), VERIFY_TIMEOUT_S):
        return view.stowaway_bytes / MIB, "granted once it had ended"


async def kill_holder(bed: Bed) -> Found:
    """Milliseconds from a holder's SIGKILL to the grant of its bytes."""
    async with bed.holder("killed") as holder:
        await holder.ask("fill", bed.part_bytes)
        began_s = time.monotonic()
        await holder.kill()
        async with bed.client.lease(_all(bed), VERIFY_TIMEOUT_S):
            return (time.monotonic() - began_s) * 1000, "and its bytes were measured back"


async def kill_daemon(bed: Bed) -> Found:
    """Seconds from the daemon's SIGKILL until its successor knows the holder again."""
    async with bed.holder("kept") as holder:
        await holder.ask("fill", bed.part_bytes)
        before = await _held(bed)
        used, began_s = await bed.used(), time.monotonic()
        await bed.restart_daemon()
        await _held(bed, before)
        seconds = time.monotonic() - began_s
        if (moved := abs(await bed.used() - used)) > VERIFY_TOLERANCE_BYTES:
            raise Missed(f"{moved / MIB:.0f} MiB changed on the GPU")
        return seconds, "the same lease, its bytes untouched"


async def _held(bed: Bed, wanted: Sequence[str] = ()) -> list[str]:
    """Wait until leases are held, and those wanted where any are. Return their ids."""
    while True:
        with suppress(VramError):  # no daemon answers yet
            leases = (await bed.client.status()).leases
            held = [one.lease_id for one in leases if one.state == "held"]
            if held and held == list(wanted or held):
                return held
        await asyncio.sleep(BEAT_S)


# -- the end
async def left_as_found(bed: Bed) -> Found:
    """MiB that are used beside those of before, once all children have ended."""
    with suppress(Missed):  # the figure says so
        await bed.returned(bed.found.used_bytes)
    reading = await bed.read()
    if own := [pid for pid in reading.processes or () if is_below(pid, os.getpid())]:
        raise Missed(f"processes of this test are on the GPU: {own}")
    remark = (
        f"{len(bed.found.processes or ())} processes before, {len(reading.processes or ())} now"
    )
    return (reading.used_bytes - bed.found.used_bytes) / MIB, remark


# -- models
async def fork_server(bed: Bed) -> Found:
    """Processes of a sidecar, and the daemon, that have a context, beside the one of its model."""
    async with bed.model(POLICY) as model:
        pids = [int(one.name) for one in procfs.PROC.iterdir() if one.name.isdecimal()]
        tree = [pid for pid in pids if is_below(pid, model.pid)]
        tree.append(bed.programs.running["arbiter"].process.pid)
        listed = (await bed.read()).processes or {}
        holding = [pid for pid in tree if listed.get(pid) or _opened_uvm(pid)]
    if not holding:
        raise Missed("no process of the sidecar has a context")
    return len(holding) - 1, f"of {len(tree)} processes"


def _opened_uvm(pid: int) -> bool:
    try:
        return any(os.readlink(one) == UVM for one in Path(f"/proc/{pid}/fd").iterdir())
    except OSError:  # a file was closed meanwhile, or the process has ended
        return False


async def answered(skill: str, bed: Bed) -> Found:
    """Milliseconds of a model's answer, the second one: the first loads its kernels."""
    before = await bed.used()
    async with bed.model(skill) as model:
        for _ in range(2):
            began_s = time.perf_counter()
            await ASKED[model.manifest.kind](model.client, model.manifest)
            seconds = time.perf_counter() - began_s
        return seconds * 1000, f"resident in {(await bed.used() - before) / MIB:.0f} MiB"


ROWS: Final = (
    Row(
        "reading", "a reading of the GPU", "ms", reading, "probe.load_s", most=LOAD_PROBE_S * 1000
    ),
    Row("context", "an empty context", "MiB", context, "limits.md: 0.1 to 0.6 GB", most=572.0),
    Row(
        "lag-free", "freed memory is measured", "ms", lag_free, VERIFY, most=VERIFY_TIMEOUT_S * 1000
    ),
    Row(
        "lag-exit", "memory of an ended process is measured", "ms", lag_exit, VERIFY,
        most=VERIFY_TIMEOUT_S * 1000,
    ),
    Row(
        "restore", "a restore, by cudaMemcpy", "times", restore, "performance.md", most=2.0,
        hardware=True,
    ),
    Row(
        "page-locked", "page-locked by pageable memory", "times", page_locked,
        "CUDA C++ Best Practices: pinned memory", least=1.0, hardware=True,
    ),
    Row(
        "nf4", "NF4 on GPU and CPU differ", "", nf4, "the CPU's answer", most=1e-3,
        hardware=True,
    ),
    Row(
        "checkpoint", "a suspended process leaves", "MiB", checkpoint, "verify.tolerance_bytes",
        most=TOLERANCE_MIB, hardware=True, limit_s=45.0,
    ),
    Row(
        "evict", "an eviction is verified", "ms", evict, VERIFY, most=VERIFY_TIMEOUT_S * 1000
    ),
    Row("stowaway", "a stowaway blocks grants", "MiB", stowaway, "limits.md", least=1.0),
    Row(
        "kill-holder", "a killed holder's bytes are granted", "ms", kill_holder, VERIFY,
        most=VERIFY_TIMEOUT_S * 1000,
    ),
    Row(
        "kill-daemon", "a killed daemon's successor knows the holder", "s", kill_daemon,
        "lease.ttl_s + lease.fence_grace_s", most=LEASE_TTL_S + FENCE_GRACE_S,
    ),
    Row(
        "fork-server", "contexts beside the model's", "processes", fork_server,
        "limits.md: a context stays", most=0.0, skill=POLICY, limit_s=MODEL_S + 10.0,
    ),
    Row(
        "detector", "a detector answers", "ms", partial(answered, DETECTOR),
        f"latency_budget of {DETECTOR}", most=1000.0, skill=DETECTOR, limit_s=MODEL_S + 10.0,
    ),
    Row(
        "vlm", "a scene VLM answers", "ms", partial(answered, VLM), f"latency_budget of {VLM}",
        most=3000.0, skill=VLM, limit_s=MODEL_S + 10.0,
    ),
    Row(
        "policy", "a policy answers", "ms", partial(answered, POLICY),
        f"latency_budget of {POLICY}", most=400.0, skill=POLICY, limit_s=MODEL_S + 10.0,
    ),
)  # fmt: skip
LAST: Final = Row(
    "left-as-found", "bytes that were not used before", "MiB", left_as_found,
    "verify.tolerance_bytes", most=TOLERANCE_MIB,
)  # fmt: skip
"""Measured after all children have ended."""
