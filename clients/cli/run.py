"""`vramctl run`: a lease for a program that knows nothing of the arbiter. Acquire, start it, pass signals on, release when it ends.

The lease belongs to `vramctl`, the bytes to its child: a consumer is a process tree, and the arbiter books a child's bytes on its nearest
ancestor with a lease, so they are measured as this lease's, shown as "vramctl (python)". A program that leaves `vramctl`'s tree (it
daemonises) or leases for itself is not covered by this lease. By default the lease is pinned, because a
program that cannot unload can only be killed, and whether that is safe is for a person to say (`--on-revoke term`).
"""

import asyncio
import os
import shutil
import signal
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Self

from clients import traces
from clients.aio import ArbiterClient
from clients.lease import Lease
from schemas.errors import VramError
from schemas.wire import Footprint, LeaseSpec

PATIENCE_S = 1.0
NOT_FOUND, NOT_STARTED = 127, 126  # as shells have it
FORWARDED = (signal.SIGTERM, signal.SIGHUP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGCONT, signal.SIGWINCH)


@dataclass(frozen=True, slots=True)
class RunSpec:
    """What to run and what it needs. `term_on_revoke` False pins the lease."""

    command: list[str]
    name: str | None
    vram_bytes: int
    gpu: str
    priority: int
    wait_timeout_s: float | None
    exclusive: bool
    term_on_revoke: bool


def lease_spec(spec: RunSpec) -> LeaseSpec:
    """The program's whole need for its whole life: nothing is known of phases inside it. It leaves no residue: it exits."""
    name = spec.name or Path(spec.command[0]).name
    return LeaseSpec(
        consumer=name,
        model_id=name,
        gpu=spec.gpu,
        mode="exclusive" if spec.exclusive else "shared",
        footprint=Footprint(load_peak_bytes=spec.vram_bytes, steady_bytes=spec.vram_bytes, residue_bytes=0),
        priority=spec.priority,
        evictable=spec.term_on_revoke,
    )


async def run_leased(spec: RunSpec, endpoint: str | None) -> int:
    """The program's exit code. Raises the typed error of a lease that was not granted, ArbiterUnreachable."""
    program = shutil.which(spec.command[0])
    if program is None:
        print(f"vramctl run: {spec.command[0]}: not found", file=sys.stderr)
        return NOT_FOUND
    async with ArbiterClient(endpoint, name=f"vramctl run {spec.name or Path(program).name}"[:128]) as client:
        child: asyncio.subprocess.Process | None = None

        async def ended() -> None:
            """Room is wanted: SIGTERM, and however long the program takes to end well, it is not cut short."""
            if child is not None and child.returncode is None:
                print("vramctl run: its room is wanted; sending SIGTERM", file=sys.stderr)
                child.terminate()
                await child.wait()

        def lost(lease: Lease, error: VramError) -> None:
            print(f"vramctl run: {lease.lease_id} was lost: {error}", file=sys.stderr)

        acquiring = client.acquire(
            lease_spec(spec),
            spec.wait_timeout_s,
            unload=ended if spec.term_on_revoke else None,
            on_lost=lost,
        )
        lease = await _tell_why(client, asyncio.ensure_future(acquiring), lease_spec(spec).consumer)
        with _Forwarding() as signals:
            try:
                child = await asyncio.create_subprocess_exec(program, *spec.command[1:], env=_environ(lease))
            except OSError as error:
                print(f"vramctl run: {program}: {error.strerror}", file=sys.stderr)
                await lease.release()
                return NOT_STARTED
            signals.to(child)
            ready = client.spawn(lease.ready(), f"ready {lease.lease_id}")
            code = await child.wait()
            ready.cancel()
            await lease.release(exiting=True)
    return code if code >= 0 else 128 - code


async def _tell_why(client: ArbiterClient, acquiring: asyncio.Future[Lease], consumer: str) -> Lease:
    """The lease; a person who waits for it is told once whom for."""
    try:
        done, _ = await asyncio.wait({acquiring}, timeout=PATIENCE_S)
        if not done:
            for entry in (await client.why(consumer))["leases"]:
                if entry["state"] == "queued":
                    print(f"vramctl run: waiting: {entry['text']}", file=sys.stderr)
        return await acquiring
    finally:
        acquiring.cancel()


class _Forwarding:
    """Signals go to the program, whose end is ours: from before it starts, so that none ends us while it runs. Ctrl-C reaches it from the
    terminal; we only have to outlive it."""

    def __init__(self) -> None:
        self._child: asyncio.subprocess.Process | None = None
        self._early: list[signal.Signals] = []

    def __enter__(self) -> Self:
        loop = asyncio.get_running_loop()
        for number in FORWARDED:
            loop.add_signal_handler(number, self._forward, number)
        loop.add_signal_handler(signal.SIGINT, lambda: None)
        return self

    def __exit__(self, *_: object) -> None:
        for number in (*FORWARDED, signal.SIGINT):
            asyncio.get_running_loop().remove_signal_handler(number)

    def to(self, child: asyncio.subprocess.Process) -> None:
        """It has started."""
        self._child = child
        for number in self._early:
            self._forward(number)

    def _forward(self, number: signal.Signals) -> None:
        if self._child is None:
            self._early.append(number)
        elif self._child.returncode is None:
            self._child.send_signal(number)


def _environ(lease: Lease) -> dict[str, str]:
    return {
        **os.environ,
        **traces.environ(),
        "VRAM_LEASE_ID": lease.lease_id,
        "VRAM_LEASE_TOKEN": f"{lease.token[0]}.{lease.token[1]}",
        "VRAM_LEASE_GPU": lease.gpu,
    }
