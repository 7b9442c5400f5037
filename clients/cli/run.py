"""`vramctl run`: a lease for a program that knows nothing of the arbiter. Acquire, start it, pass
signals on, release when it ends.

The lease belongs to `vramctl`, the bytes to its child: a consumer is a process tree, and the
arbiter charges a child's bytes to its nearest ancestor with a lease. A program that leaves the tree
(it daemonizes) or leases for itself is not covered.

A program cannot unload, it can only end. So it counts as one long use, and what a revoke does is
decided here (`ON_REVOKE`).
"""

import argparse
import asyncio
import contextlib
import logging
import os
import shutil
import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

from pydantic import ValidationError

from vram_arbiter.clients import cuda
from vram_arbiter.clients._protocol import traces
from vram_arbiter.clients._protocol.records import Eviction
from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.signals import Forwarding
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.lease import AsyncLease
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS
from vram_arbiter.schemas.errors import VramError
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes, parse_bytes
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.requests import checked_spec
from vram_arbiter.schemas.wire.spec import Footprint, LeaseSpec

log = logging.getLogger(__name__)

PRIORITY = 40
"""Below that of other leases: programs make room for a robot's models, and queue among
themselves."""
OnRevoke = Literal["priority", "term", "pin"]
ON_REVOKE: tuple[OnRevoke, ...] = ("priority", "term", "pin")
"""priority: end the program for a request of a higher priority, or for an operator; others wait
until it ends. term: end it for any request, and when the arbiter stays away. pin: never."""

DESCRIPTIONS = {
    "run": "Run a program that knows nothing of the arbiter under a lease: vramctl run --vram 5GiB "
    "-- python train.py. The program sees VRAM_LEASE_ID, VRAM_LEASE_TOKEN and VRAM_LEASE_GPU, and "
    "CUDA_VISIBLE_DEVICES unless that was set; signals are passed on. Two programs that do not fit "
    "together run one after the other. At the end the measured peak is printed. Exits with the "
    "program's code (128+n if signal n ended it), 1 if no lease was granted, 3 without an arbiter, "
    "126 or 127 if the program cannot be started."
}
PATIENCE_S = 1.0
FIRST_LOOK_S, LOOK_S = 0.2, 1.0  # the arbiter reads the GPU once a second
NOT_FOUND, NOT_STARTED = 127, 126  # as shells have it


@dataclass(frozen=True, slots=True)
class RunSpec:
    """What to run and what it needs. `grace_s`: from SIGTERM to SIGKILL; None waits for as long as
    the program takes."""

    command: list[str]
    name: str | None
    vram_bytes: int
    gpu: str
    priority: int
    wait_timeout_s: float | None
    exclusive: bool
    on_revoke: OnRevoke
    grace_s: float | None

    @property
    def consumer(self) -> str:
        """`--name`, or the program's, which may hold any byte and be of any length."""
        return self.name or printable(Path(self.command[0]).name)[:NAME_MAX_CHARS] or "program"


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument("--vram", required=True, type=_bytes, help="bytes it needs, e.g. 5GiB")
    parser.add_argument("--name", help="consumer's name (default: the program's)")
    parser.add_argument("--gpu", default="any", help="uuid, index or any (default: any)")
    parser.add_argument(
        "--priority",
        type=arguments.count(0, 100),
        default=PRIORITY,
        help="below the 50 of other leases, so that a robot's models go first (default: "
        "%(default)s)",
    )
    parser.add_argument(
        "--wait",
        type=arguments.at_least(0.0),
        metavar="SECONDS",
        help="give up after so many seconds (default: never)",
    )
    parser.add_argument("--exclusive", action="store_true", help="no other model on that GPU")
    parser.add_argument("--pin", action="store_true", help="never end the program to make room")
    parser.add_argument(
        "--on-revoke",
        choices=ON_REVOKE,
        default="priority",
        help="priority: end the program for a request of a higher priority or an operator, others "
        "wait; term: end it for any request; pin: as --pin (default: %(default)s)",
    )
    parser.add_argument(
        "--grace",
        type=arguments.at_least(0.0),
        metavar="SECONDS",
        help="from SIGTERM to SIGKILL (default: as long as the program takes)",
    )
    arguments.add_endpoint(parser)
    parser.add_argument(
        "command", nargs=argparse.REMAINDER, metavar="COMMAND", help="the program, after `--`"
    )


def run(args: argparse.Namespace) -> int:
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if not command:
        args.parser.error("expected a program to run: vramctl run --vram 5GiB -- COMMAND")
    if args.pin and args.on_revoke == "term":
        args.parser.error("--pin and --on-revoke term exclude each other")
    spec = RunSpec(
        command,
        args.name,
        args.vram,
        args.gpu,
        args.priority,
        args.wait,
        args.exclusive,
        "pin" if args.pin else args.on_revoke,
        args.grace,
    )
    try:
        checked_spec(to_map(lease_spec(spec)))
    except ValidationError as error:
        problem = error.errors()[0]
        option = "--gpu" if problem["loc"] == ("gpu",) else "--name"
        args.parser.error(f"{option}: {problem['msg']}, got {problem['input']!r}")
    return asyncio.run(run_leased(spec, args.endpoint))


def _bytes(written: str) -> int:
    """Argparse type: a byte size such as 5GiB."""
    try:
        return parse_bytes(written)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from error


def lease_spec(spec: RunSpec) -> LeaseSpec:
    """The program's whole need for its whole life: nothing is known of phases inside it. It leaves
    no residue: it exits."""
    return LeaseSpec(
        consumer=spec.consumer,
        model_id=spec.consumer,
        gpu=spec.gpu,
        mode="exclusive" if spec.exclusive else "shared",
        footprint=Footprint(
            load_peak_bytes=spec.vram_bytes, steady_bytes=spec.vram_bytes, residue_bytes=0
        ),
        priority=spec.priority,
        evictable=spec.on_revoke != "pin",
    )


async def run_leased(spec: RunSpec, endpoint: str | None) -> int:
    """The program's exit code. Raises the typed error of a lease that was not granted,
    ArbiterUnreachable."""
    program = shutil.which(spec.command[0])
    if program is None:
        code, problem = _why_not(spec.command[0])
        _say(f"{spec.command[0]}: {problem}")
        return code
    async with AsyncClient(
        f"vramctl run {spec.consumer}"[:NAME_MAX_CHARS], endpoint=endpoint
    ) as client:
        run = _Run(spec, client)
        acquiring = client.acquire(
            lease_spec(spec),
            spec.wait_timeout_s,
            unload={"pin": None, "term": run.end, "priority": run.ended}[spec.on_revoke],
            on_revoke=run.revoke_asked,
            on_lost=run.lost,
        )
        lease = await _tell_why(client, asyncio.ensure_future(acquiring), spec.consumer)
        with Forwarding() as signals:
            try:
                child = await asyncio.create_subprocess_exec(
                    program, *spec.command[1:], env=_environ(lease)
                )
            except OSError as error:
                _say(f"{program}: {error.strerror}")
                await lease.release()
                return NOT_STARTED
            signals.to(child)
            code = await run.until_ended(child, lease)
            await lease.release(exiting=True)
    return code if code >= 0 else 128 - code


class _Run:
    """One program under one lease, from its start to its end."""

    def __init__(self, spec: RunSpec, client: AsyncClient) -> None:
        self._spec = spec
        self._client = client
        self._child: asyncio.subprocess.Process | None = None
        self.peak_bytes = 0
        self._wake = asyncio.Event()
        self._ending = False
        self._last: asyncio.Task[None] | None = None  # ends the program
        self._reason = "its lease is over"  # said when the program is made to end
        self._told: set[str] = set()  # waiters that were named to the user

    async def until_ended(self, child: asyncio.subprocess.Process, lease: AsyncLease) -> int:
        self._child = child
        background = [
            asyncio.create_task(self._hold(lease)),
            asyncio.create_task(self._watch(lease)),
        ]
        code = await child.wait()
        for task in background:
            task.cancel()
        for outcome in await asyncio.gather(*background, return_exceptions=True):
            if isinstance(outcome, VramError):
                log.warning("%s: %s", lease.lease_id, outcome)
        if self.peak_bytes:
            asked = self._spec.vram_bytes
            more = ", more than was asked for" if self.peak_bytes > asked else ""
            _say(
                f"peak {format_bytes(self.peak_bytes)} measured of {format_bytes(asked)} "
                f"asked{more}"
            )
        else:
            _say("peak not measured: no reading showed bytes of the program")
        return code

    async def _hold(self, lease: AsyncLease) -> None:
        """The program is one long use, unless any request may end it."""
        await lease.ready()
        if self._spec.on_revoke != "term":
            async with lease.use(self._spec.consumer):
                await asyncio.Event().wait()  # until canceled

    async def _watch(self, lease: AsyncLease) -> None:
        """Measure the peak, and see which requests the program keeps waiting."""
        pause_s = FIRST_LOOK_S
        while True:
            with contextlib.suppress(TimeoutError):
                await asyncio.wait_for(self._wake.wait(), pause_s)
            self._wake.clear()
            self._decide(lease, None)
            with contextlib.suppress(VramError):
                status = await self._client.ask("status")  # its first page has all queues' heads
                assert isinstance(status, StatusReply)
                self._measure(lease, status)
                self._decide(lease, status)
            pause_s = LOOK_S

    def _measure(self, lease: AsyncLease, status: StatusReply) -> None:
        used = sum(
            process.used_bytes or 0
            for gpu in status.gpus
            for process in gpu.processes
            if lease.lease_id in process.lease_ids
        )
        self.peak_bytes = max(self.peak_bytes, used)

    # -- revoke
    async def revoke_asked(self, lease: AsyncLease, eviction: Eviction) -> None:
        self._reason = eviction.reason
        self._wake.set()

    async def lost(self, lease: AsyncLease, error: VramError) -> None:
        _say(f"{lease.lease_id} was lost: {error}")

    def _decide(self, lease: AsyncLease, status: StatusReply | None) -> None:
        """End the program where a revoke is for a higher priority. A request that came after the
        revoke is seen in `status`."""
        eviction = lease.evicted
        if eviction is None or self._ending or self._spec.on_revoke != "priority":
            return
        waiting = [
            (view.consumer, view.priority)
            for view in (() if status is None else status.leases)
            if view.state == "queued" and view.gpu in (None, lease.gpu)
        ]
        asked_by = self._spec.priority + 1 if eviction.priority is None else eviction.priority
        waiting.append((eviction.by, asked_by))
        consumer, priority = max(waiting, key=lambda one: one[1])
        if priority > self._spec.priority:
            self._reason = (
                eviction.reason if consumer == eviction.by else f"{consumer} needs the room"
            )
            self._last = asyncio.create_task(self.end())
        elif consumer not in self._told:
            self._told.add(consumer)
            _say(
                f"{consumer} waits for its room (priority {priority}): it gets it when the program "
                "ends"
            )

    async def ended(self) -> None:
        if self._child is not None:
            await self._child.wait()

    async def end(self) -> None:
        """SIGTERM, and SIGKILL after the grace. Returns when the program has ended."""
        child = self._child
        if child is None or child.returncode is not None or self._ending:
            return
        self._ending = True
        _say(f"{self._reason}; sending SIGTERM")
        child.terminate()
        try:
            await asyncio.wait_for(child.wait(), self._spec.grace_s)
        except TimeoutError:
            _say(f"still running after {self._spec.grace_s:g} s; sending SIGKILL")
            child.kill()
            await child.wait()


async def _tell_why(
    client: AsyncClient, acquiring: asyncio.Future[AsyncLease], consumer: str
) -> AsyncLease:
    """Return the lease. Say once, on stderr, what a long wait is for."""
    try:
        done, _ = await asyncio.wait({acquiring}, timeout=PATIENCE_S)
        if not done:
            for entry in (await client.why(consumer)).leases:
                if entry.state == "queued":
                    _say(f"waiting: {entry.text}")
        return await acquiring
    finally:
        acquiring.cancel()


def _why_not(command: str) -> tuple[int, str]:
    """The exit code and the reason for a command that is not an executable file."""
    folders = [""] if os.sep in command else os.environ.get("PATH", os.defpath).split(os.pathsep)
    found = [
        path
        for folder in folders
        if command and os.path.exists(path := os.path.join(folder, command))
    ]
    if not found:
        return NOT_FOUND, "not found"
    return NOT_STARTED, "is a directory" if os.path.isdir(found[0]) else "permission denied"


def _environ(lease: AsyncLease) -> dict[str, str]:
    return {
        **os.environ,
        **traces.environ(),
        **cuda.visible(lease.gpu, os.environ),
        "VRAM_LEASE_ID": lease.lease_id,
        "VRAM_LEASE_TOKEN": f"{lease.token[0]}.{lease.token[1]}",
        "VRAM_LEASE_GPU": lease.gpu,
    }


def _say(text: str) -> None:
    print(f"vramctl run: {printable(text)}", file=sys.stderr)
