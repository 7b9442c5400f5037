"""The whole arbiter under faults: three seeds in every run of the tests, with every kind of fault,
note and verdict of six; a few more at night. `make sim SEEDS=1000` runs many, `make sim SEED=n` one
again."""

import asyncio
import contextlib
import functools
import os
import subprocess
import sys
from collections.abc import Awaitable, Callable, Iterator
from dataclasses import replace
from pathlib import Path

import pytest

from tests.sim.sim_clients import SimClient
from tests.sim.sim_run import run_seed, summary
from tests.support.processes import alive, children
from tests.support.simulation.clock import Clock, new_loop
from tests.support.simulation.daemon import Happening
from tests.support.simulation.device import Device, SimOutOfMemory
from tests.support.simulation.world import Entitlement, SimFailure, SimProcess, World
from tests.support.waiting import until
from vram_arbiter.clients._spec import checked_spec
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.ids import GpuId, ProcessKey
from vram_arbiter.schemas.wire.spec import Footprint

first_report = functools.cache(run_seed)
"""The report of a seed, simulated once for all tests: each run costs seconds of a core."""

A, B, GPU = ProcessKey(1, 1), ProcessKey(2, 2), GpuId("GPU-0")


@pytest.mark.parametrize(
    "seed", [0, 2, 3, *(pytest.param(seed, marks=pytest.mark.nightly) for seed in (1, 4, 5))]
)
def test_nothing_that_must_hold_breaks_under_faults(seed: int) -> None:
    report = first_report(seed)
    assert not report.failure, report.failure
    assert report.granted > 0
    assert sum(report.faults.values()) > 20


def test_waiters_give_up_while_holders_are_revoked_for_them() -> None:
    report = first_report(2)
    assert report.notes["revoke_withdrawn"]
    assert report.faults["wait_ended_for_a_revoked_holder"]


def test_a_seed_replays_exactly() -> None:
    assert run_seed(0).digest == first_report(0).digest != first_report(2).digest


def test_sums_over_runs_name_the_seeds_that_failed() -> None:
    report = replace(first_report(0), failure="planted")
    sums = summary([report, report])
    assert sums["failed"] == [0, 0]
    assert sums["granted"] == 2 * report.granted


# -- the checks can fail
def world_with_daemon(tmp_path: Path) -> World:
    made = World(7, tmp_path)
    made.start_daemon()
    made.run(0.1)
    return made


def granted(*leases: tuple[ProcessKey, int, bool]) -> Iterator[Entitlement]:
    for number, (process, size, exclusive) in enumerate(leases):
        yield Entitlement(process, f"L1-{number}", GPU, size, 0, exclusive)


def test_more_granted_than_the_gpu_has_is_a_breach_that_names_the_seed(tmp_path: Path) -> None:
    made = world_with_daemon(tmp_path)
    made.entitlements = lambda: granted((A, 5 * GIB, False), (B, 4 * GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(
        SimFailure, match=r"(?s)daemon starts.*seed 7: GPU-0: \d+ bytes are granted or occupied"
    ):
        made.run(1.0)
    made.kill_daemon()


def test_freed_memory_that_is_not_back_yet_counts(tmp_path: Path) -> None:
    made = world_with_daemon(tmp_path)
    device = made.devices[GPU]
    device.lag_s = 10.0
    device.allocate(A, "L0-1", 5 * GIB)
    device.free(A, "L0-1")
    made.entitlements = lambda: granted((B, 4 * GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(SimFailure, match="granted or occupied"):
        made.run(1.0)
    made.kill_daemon()


def test_company_of_an_exclusive_lease_is_a_breach(tmp_path: Path) -> None:
    made = world_with_daemon(tmp_path)
    made.entitlements = lambda: granted((A, GIB, True), (B, GIB, False))
    made.clock.after(0.0, made.touch)
    with pytest.raises(SimFailure, match="beside the exclusive"):
        made.run(1.0)
    made.kill_daemon()


def test_a_token_that_does_not_grow_is_a_breach(tmp_path: Path) -> None:
    made = world_with_daemon(tmp_path)
    for lease, serial in (("L1-1", 5), ("L1-2", 4)):
        made.machine.tokens[lease] = (1, serial)
        made.machine.history.append(Happening(made.clock.now, 1, "granted", {"lease_id": lease}))
    made.clock.after(0.0, lambda: None)
    with pytest.raises(SimFailure, match="was granted after"):
        made.run(1.0)
    made.kill_daemon()


# -- the parts
def test_a_frozen_process_catches_up_and_a_dead_one_never_does() -> None:
    clock = Clock(1)
    loop, dead = new_loop(clock, "frozen"), new_loop(clock, "dead")
    happened: list[str] = []
    loop.freeze()
    loop.call_later(1.0, happened.append, "late")
    dead.call_later(1.0, happened.append, "never")
    dead.kill()
    clock.run_until(clock.now + 5.0)
    assert happened == []
    loop.thaw()
    clock.run_until(clock.now)
    assert happened == ["late"]


def test_the_gpu_refuses_what_it_has_not_got_and_gives_back_late() -> None:
    clock = Clock(1)
    device = Device(clock, GPU, 8 * GIB, 0)
    device.lag_s = 1.0
    device.allocate(A, "x", 6 * GIB)
    device.free(A, "x")
    with pytest.raises(SimOutOfMemory):
        device.allocate(B, "x", 4 * GIB)
    clock.run_until(clock.now + 1.0)
    device.allocate(B, "x", 4 * GIB)
    assert device.used_bytes() == 4 * GIB


# -- clients
async def parked_slowly(
    client: SimClient, size: int, parked: list[str], **fields: object
) -> AsyncLease:
    """A lease that is loaded and can park, which takes it a second."""

    async def park() -> None:
        parked.append("began")
        await asyncio.sleep(1.0)

    async def unload() -> None:
        parked.append("unloaded")

    footprint = Footprint(load_peak_bytes=size, steady_bytes=size, residue_bytes=0)
    spec = {
        "consumer": client.process.name,
        "model_id": "m",
        "footprint": footprint,
        "min_residency_s": 0.0,
        **fields,
    }
    lease = await client.acquire(checked_spec(spec), park=park, unload=unload)
    await lease.ready()
    return lease


def run_client(made: World, life: Callable[[SimClient], Awaitable[None]]) -> bool:
    """Connect a client and run its life. Did it come to its end within a simulated minute?"""
    process = made.spawn("client")
    client = SimClient(made, process)
    done: list[bool] = []

    async def run() -> None:
        async with client:
            await life(client)
            done.append(True)

    process.loop.enter(lambda: process.loop.create_task(run()))
    made.run(60.0, lambda: bool(done))
    made.kill(process)
    made.kill_daemon()
    return bool(done)


def test_a_lease_that_is_given_up_while_it_parks_ends(tmp_path: Path) -> None:
    """Regression: `give_up` waited for ever for an end, and the lease slept."""
    made = world_with_daemon(tmp_path)
    parked: list[str] = []

    async def life(client: SimClient) -> None:
        lease = await parked_slowly(client, GIB, parked, park_bytes=GIB)
        parking = asyncio.ensure_future(lease.park())
        await asyncio.sleep(0.5)
        await lease.give_up()
        await parking

    assert run_client(made, life)
    assert parked == ["began", "unloaded"]


def test_a_wait_to_come_back_outlives_the_daemon(tmp_path: Path) -> None:
    """Regression: after a restart the arbiter knew that the lease was parked, but not that it was
    wanted."""
    made = world_with_daemon(tmp_path)
    parked: list[str] = []

    async def life(client: SimClient) -> None:
        lease = await parked_slowly(client, 5 * GIB, parked, park_bytes=5 * GIB)
        await lease.park()
        other = await parked_slowly(client, 5 * GIB, parked, consumer="other", model_id="other")
        device, key = made.devices[GPU], client.process.key
        device.allocate(key, other.lease_id, 5 * GIB)
        async with other.use():
            back = asyncio.ensure_future(lease.reacquire())
            await asyncio.sleep(0.5)
            made.clock.after(0.0, made.kill_daemon)
            made.clock.after(0.1, made.start_daemon)
            await asyncio.sleep(3.0)
        device.free(key, other.lease_id)
        await other.wait_gone()
        await back

    assert run_client(made, life)


def test_a_lease_that_finds_no_host_ram_to_park_is_released_all_the_same(tmp_path: Path) -> None:
    """Regression: a release that was refused ended the task that leaves, and the lease stayed
    `unloading` for ever."""
    made = world_with_daemon(tmp_path)
    parked: list[str] = []

    async def life(client: SimClient) -> None:
        lease = await parked_slowly(client, GIB, parked, park_bytes=7 * GIB)
        waiting = asyncio.ensure_future(lease.park())
        await lease.wait_gone()
        await waiting

    assert run_client(made, life)
    assert parked == ["began", "unloaded"]


# -- a revoke that is withdrawn
def connected(made: World, name: str, life: Callable[[SimClient], Awaitable[None]]) -> SimProcess:
    """A process whose client lives so, connected."""
    process = made.spawn(name)
    client = SimClient(made, process)

    async def run() -> None:
        async with client:
            await life(client)
            await asyncio.sleep(1000.0)

    process.loop.enter(lambda: process.loop.create_task(run()))
    return process


def kinds(made: World) -> list[str]:
    return [note.kind for note in made.machine.history]


@pytest.mark.parametrize("lost", [False, True], ids=["answered", "its answer is lost"])
def test_an_unloading_that_crosses_the_withdrawal_completes(tmp_path: Path, lost: bool) -> None:
    """The holder ended its use, and sent `unloading`, before it heard that its revoke was
    withdrawn. Where the answer was lost it took the lease for held, and the arbiter waited for the
    end of its unload for ever."""
    made = world_with_daemon(tmp_path)
    holder_ends, parked = asyncio.Event(), list[str]()
    leases: list[AsyncLease] = []

    async def hold(client: SimClient) -> None:
        lease = await parked_slowly(client, 5 * GIB, parked, park_bytes=5 * GIB, standby=True)
        async with lease.use():
            leases.append(lease)
            await holder_ends.wait()

    async def give_up(client: SimClient) -> None:
        with contextlib.suppress(TimeoutError):
            async with asyncio.timeout(0.5):
                await parked_slowly(client, 5 * GIB, parked)

    holder = connected(made, "holder", hold)
    assert made.run(5.0, lambda: bool(leases))
    waiter = connected(made, "waiter", give_up)
    assert made.run(5.0, lambda: "revoke_withdrawn" in kinds(made))
    assert leases[0].state == "revoking", "it has not heard of it"
    holder.loop.enter(holder_ends.set)
    assert made.run(5.0, lambda: "unloading" in kinds(made))
    if lost:
        for link in holder.links:
            link.cut(told=False)
        daemon = made.daemon
        assert daemon is not None
        daemon.loop.freeze()
        made.run(8.0)  # longer than the holder waits for the answer
        daemon.loop.thaw()
    assert made.run(30.0, lambda: "parked" in kinds(made))
    assert made.run(30.0, lambda: leases[0].state == "loading"), "it comes back as from an eviction"
    assert parked == ["began"]
    for process in (holder, waiter):
        made.kill(process)
    made.kill_daemon()


# -- many
ENDS_S = 10.0
"""Shorter than the seeds take that a worker has been given."""


def folders_of(pid: int) -> set[Path]:
    """Return the folders of a simulation in which a process has files open."""
    found = set()
    for one in Path(f"/proc/{pid}/fd").iterdir():
        with contextlib.suppress(OSError):
            found |= {path for path in Path(os.readlink(one)).parents if "vram-sim-" in path.name}
    return found


def test_workers_end_with_the_program_that_started_them() -> None:
    """They simulated on, and kept their folders."""
    command = [sys.executable, "-m", "tests.sim.sim_run", "--seeds", "100", "--jobs", "1"]
    with subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE) as run:
        found = until(lambda: {pid: made for pid in children(run.pid) if (made := folders_of(pid))})
        run.kill()
    until(lambda: not any(map(alive, found)), ENDS_S)
    assert [folder for folders in found.values() for folder in folders if folder.exists()] == []
