"""An eviction split into what the arbiter adds, what the holder takes and what the driver takes to
give memory back.

Two clients of 5 GiB on a simulated GPU of 8 GiB. The holder's bytes lie on the GPU as a process
file; when it unloads it writes when they come back. The arbiter's part is from the waiter's acquire
to the holder's `revoke`, plus from the memory's return to the grant.
"""

import os
import time
from contextlib import ExitStack
from pathlib import Path

from tests.bench.harness import WIDE, Peer, Suite, arbiter
from tests.support.process import ArbiterProcess
from vram_arbiter.schemas import fakegpu
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs
from vram_arbiter.schemas.runtime.fakegpu_folder import locked

LAG_S = 0.15
NO_HOLD = "scheduling:\n  thrash_hold_max_s: 0\n"
"""Two that throw each other out without pause are what the arbiter slows down on purpose; it is
asked not to, as with `min_residency_s`."""


def run(suite: Suite) -> None:
    with ExitStack() as stack:
        daemon = stack.enter_context(arbiter(WIDE + NO_HOLD))
        peers = [Peer(daemon.endpoint, name).greeted() for name in ("one", "two")]
        for peer in peers:
            stack.callback(peer.close)
        at_once = [evict_all(daemon, peers, 0.0) for _ in range(suite.size(200, 20))]
        later = [evict_all(daemon, peers, LAG_S) for _ in range(suite.size(40, 5))]
    suite.time("eviction: acquire to revoke", [asked for asked, _, _ in at_once])
    suite.time("eviction: the holder's part", [held for _, held, _ in at_once])
    suite.time(
        "eviction: release to grant, memory back at once", [noticed for _, _, noticed in at_once]
    )
    added = [asked + noticed for asked, _, noticed in at_once]
    suite.limit("eviction: added by the arbiter", added, p99_max_us=5000.0)
    name = f"eviction: memory back to grant, {LAG_S * 1000:.0f} ms late"
    suite.limit(name, [noticed for _, _, noticed in later], p99_max_us=10_000.0)


def evict_all(
    daemon: ArbiterProcess, peers: list[Peer], lag_s: float
) -> tuple[float, float, float]:
    """(acquire → revoke, revoke → release, release or memory back → grant) in microseconds. The
    peers change places."""
    holder, waiter = peers
    held = holder.lease(5 * GIB)
    put(daemon.gpu_folder, 5 * GIB)
    holder.ready(held)
    start = time.perf_counter()
    request = waiter.want(5 * GIB)
    holder.push("revoke")
    asked = time.perf_counter()
    holder.ask("unloading", lease_id=held["lease_id"], token=held["token"])
    back_at = give_back(daemon.gpu_folder, lag_s)
    released = time.perf_counter()
    goodbye = holder.letting_go(held)
    lease = waiter.push("granted")["lease"]
    noticed = time.monotonic() - back_at if lag_s else time.perf_counter() - released
    waiter.reply(request)
    holder.reply(goodbye)
    waiter.release(lease)
    holder.settle()
    peers.reverse()
    return (asked - start) * 1e6, (released - asked) * 1e6, noticed * 1e6


def put(gpu_folder: Path, size: int) -> None:
    """This process holds so many bytes on the GPU."""
    _write(gpu_folder, fakegpu.ProcessFile(**_me(), allocated_bytes=size))


def give_back(gpu_folder: Path, lag_s: float) -> float:
    """They are on their way back; returns when they are there (monotonic seconds)."""
    back_at = time.monotonic() + lag_s
    if lag_s:
        returning = (fakegpu.Returning(bytes=5 * GIB, due_s=back_at),)
        _write(gpu_folder, fakegpu.ProcessFile(**_me(), returning=returning))
    else:
        _write(gpu_folder, fakegpu.ProcessFile(**_me()))
    return back_at


def _me() -> dict[str, object]:
    ticks = procfs.start_ticks(os.getpid()) or 0
    return {"pid": os.getpid(), "start_ticks": ticks, "name": "bench"}


def _write(gpu_folder: Path, mine: fakegpu.ProcessFile) -> None:
    name = fakegpu.file_name(ProcessKey(mine.pid, mine.start_ticks))
    with locked(gpu_folder):
        temporary = gpu_folder / f".{name}.bench"
        temporary.write_text(mine.model_dump_json())
        temporary.rename(gpu_folder / name)
