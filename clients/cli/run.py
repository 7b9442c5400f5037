"""`vramctl run`: a lease for a program that knows nothing of the arbiter. Acquire, start it, pass
signals on, release when it ends.

The lease belongs to `vramctl`, the bytes to its child: a consumer is a process tree, and the
arbiter charges a child's bytes to its nearest ancestor with a lease. A program that leaves the tree
(it daemonizes) or leases for itself is not covered. A systemd unit or a container is not a child:
its lease names its cgroup.

What happens on an eviction is `clients.foreign`'s; docs/how-to/foreign-programs.md explains it.
"""

import argparse
import asyncio
import json
import os
import shutil
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Final, NoReturn
from urllib.parse import urlsplit

from pydantic import ValidationError

from vram_arbiter.clients._spec import checked_spec
from vram_arbiter.clients.cli import arguments
from vram_arbiter.clients.cli.signals import Forwarding
from vram_arbiter.clients.client import AsyncClient
from vram_arbiter.clients.foreign.actions import Action
from vram_arbiter.clients.foreign.control import Control
from vram_arbiter.clients.foreign.cuda_checkpoint import CheckpointAction, CudaDriver
from vram_arbiter.clients.foreign.http import HttpAction, Request, checked_url
from vram_arbiter.clients.foreign.program import adopt_orphans
from vram_arbiter.clients.foreign.run_spec import OnRevoke, RunSpec, lease_spec
from vram_arbiter.clients.foreign.say import say
from vram_arbiter.clients.foreign.servers import SERVERS
from vram_arbiter.clients.foreign.service import Service, find_container, find_unit
from vram_arbiter.clients.foreign.supervisor import Supervisor
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.defaults import MIN_RESIDENCY_S, NAME_MAX_CHARS
from vram_arbiter.schemas.errors import ConfigError
from vram_arbiter.schemas.wire.requests import Status
from vram_arbiter.schemas.wire.views import GpuView

PRIORITY: Final = 40
"""Below that of other leases: programs make room for a robot's models, and queue among
themselves."""
ON_REVOKE: Final[tuple[OnRevoke, ...]] = ("priority", "term", "pin")
"""priority: make room for a request of a higher priority, or for an operator; others wait until the
program ends. term: make room for any request, and when the arbiter stays away. pin: never."""
CHECKPOINT: Final = "cuda-checkpoint"
ON_EVICT: Final = ("end", "stop", "http", *SERVERS, CHECKPOINT)
OPTIONS: Final = (
    "url", "restore_url", "allow_remote", "timeout", "park",
)  # fmt: skip
TIMEOUT_S: Final = 60.0
GATEWAY: Final = ("vram_arbiter.sidecars.gateway", "serve", "--config", "-")
"""Started as a program: clients import no sidecar."""
NOT_FOUND, NOT_STARTED = 127, 126  # as shells have it

DESCRIPTIONS = {
    "run": "Run a program that knows nothing of the arbiter under a lease: vramctl run --vram 5GiB "
    "-- python train.py. The program sees VRAM_LEASE_ID, VRAM_LEASE_TOKEN and VRAM_LEASE_GPU, and "
    "CUDA_VISIBLE_DEVICES unless that was set; signals are passed on. Two programs that do not fit "
    "together run one after the other. At the end the measured peak is printed. Exits with the "
    "program's code (128+n if signal n ended it), 1 if no lease was granted, 3 without an arbiter, "
    "126 or 127 if the program cannot be started."
}


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    parser.add_argument(
        "--vram", required=True, type=arguments.size, help="bytes it needs, e.g. 5GiB"
    )
    parser.add_argument(
        "--unit",
        metavar="NAME",
        help="in place of COMMAND: a systemd service of this user, else of the machine; one that "
        "runs is adopted, and it ends with vramctl",
    )
    parser.add_argument(
        "--container", metavar="NAME", help="in place of COMMAND: a container of podman or docker"
    )
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
        help="give up after this many seconds (default: never)",
    )
    parser.add_argument("--exclusive", action="store_true", help="allow no other model on that GPU")
    parser.add_argument("--pin", action="store_true", help="never end the program to make room")
    parser.add_argument(
        "--on-revoke",
        choices=ON_REVOKE,
        help="priority: make room for a request of a higher priority or an operator, others wait; "
        "term: for any request; pin: as --pin (default: priority where the program is ended, else "
        "term)",
    )
    parser.add_argument(
        "--grace",
        type=arguments.at_least(0.0),
        metavar="SECONDS",
        help="time from SIGTERM to SIGKILL, or for requests in progress (default: as long as it "
        "takes)",
    )
    parser.add_argument(
        "--min-residency",
        type=arguments.at_least(0.0),
        default=MIN_RESIDENCY_S,
        metavar="SECONDS",
        help="after its load it stays for this long (default: %(default)s)",
    )
    parser.add_argument(
        "--health",
        metavar="URL",
        help="answers 200 once the program can serve; until then the lease is loading",
    )
    parser.add_argument(
        "--start",
        type=arguments.at_least(0.1),
        metavar="SECONDS",
        help="end the program where --health does not answer this long after its start (default: "
        "never)",
    )
    parser.add_argument(
        "--control",
        type=arguments.count(3, 1 << 20),
        metavar="FD",
        help="socket on which a program that started this one follows the lease and says when the "
        "program is wanted; it does not return by itself then, and ends with the other program",
    )
    parser.add_argument(
        "--listen",
        metavar="ADDRESS:PORT",
        help="serve the program, a model server, by HTTP there: started by the first request, "
        "and its requests wait while it is away (vram-gateway with one server; {port} in COMMAND "
        "is the port it has to listen on, unless --url says one)",
    )
    _add_eviction(parser)
    arguments.add_endpoint(parser)
    parser.add_argument(
        "command", nargs=argparse.REMAINDER, metavar="COMMAND", help="the program, after `--`"
    )


def _add_eviction(parser: argparse.ArgumentParser) -> None:
    group = parser.add_argument_group("making room (docs/how-to/foreign-programs.md)")
    group.add_argument(
        "--on-evict",
        choices=ON_EVICT,
        default="end",
        metavar="ACTION",
        help="end: end the program for good; stop: end it, and start it again when there is room; "
        "http: POST to --url to free and to --restore-url to restore; vllm, ollama, llama.cpp, "
        "comfyui: "
        "call that server's own API at --url; cuda-checkpoint: suspend its CUDA processes, and "
        "resume them (default: %(default)s)",
    )
    group.add_argument("--url", help="http: the URL that frees; a server: its address")
    group.add_argument("--restore-url", metavar="URL", help="http: the URL that restores")
    group.add_argument("--allow-remote", action="store_true", help="allow URLs of other hosts")
    group.add_argument(
        "--timeout",
        type=arguments.at_least(0.1),
        metavar="SECONDS",
        help=f"for freeing, and for restoring (default: {TIMEOUT_S:g})",
    )
    group.add_argument(
        "--park",
        type=lambda written: 0 if written == "0" else arguments.size(written),
        metavar="SIZE",
        help="host RAM that the program keeps while it is away (default: as --vram for vllm and "
        "cuda-checkpoint, else 0)",
    )


def run(args: argparse.Namespace) -> int:
    command = args.command[1:] if args.command[:1] == ["--"] else args.command
    if sum(map(bool, (command, args.unit, args.container))) != 1:
        args.parser.error(
            "expected a program to run: vramctl run --vram 5GiB -- COMMAND, or --unit NAME, or "
            "--container NAME"
        )
    if args.pin and args.on_revoke == "term":
        args.parser.error("--pin and --on-revoke term cannot be combined")
    if args.listen is not None:
        _exec_gateway(args, command)
    on_revoke: OnRevoke = "pin" if args.pin else args.on_revoke
    if on_revoke == "pin" and args.on_evict != "end":
        args.parser.error(f"a pinned program is not evicted: leave out --on-evict {args.on_evict}")
    action = _action(args)
    parks = action is not None and action.parks
    service = _service(args)
    spec = RunSpec(
        command if service is None else [service.name.removesuffix(".service")],
        args.name,
        args.vram,
        args.gpu,
        args.priority,
        args.wait,
        args.exclusive,
        on_revoke or ("priority" if action is None else "term"),
        args.grace,
        restarts=args.on_evict == "stop",
        action=action,
        park_bytes=(args.vram if parks else 0) if args.park is None else args.park,
        health="" if args.health is None else _url(args, "health"),
        start_s=args.start,
        min_residency_s=args.min_residency,
        control=_control(args),
        service=service,
    )
    try:
        checked_spec(to_map(lease_spec(spec)))
    except ValidationError as error:
        problem = error.errors()[0]
        option = "--gpu" if problem["loc"] == ("gpu",) else "--name"
        args.parser.error(f"{option}: {problem['msg']}, got {problem['input']!r}")
    return asyncio.run(run_leased(spec, args.endpoint))


def _exec_gateway(args: argparse.Namespace, command: Sequence[str]) -> NoReturn:
    """Become a gateway with this program as its only server. Exits with 2 for options that it has
    no use for."""
    for option in ("exclusive", "pin", "on_revoke", "control", "allow_remote"):
        if getattr(args, option):
            args.parser.error(f"--{option.replace('_', '-')} cannot be combined with --listen")
    urls = {
        name: urlsplit(_url(args, name)) if getattr(args, name) else None
        for name in ("url", "restore_url", "health")
    }
    by_http = args.on_evict == "http"
    given = {
        "command": command or None,
        "unit": args.unit,
        "container": args.container,
        "vram": args.vram,
        "on_evict": "stop" if args.on_evict == "end" else args.on_evict,
        "free_path": urls["url"].path if by_http and urls["url"] else None,
        "restore_path": urls["restore_url"].path if urls["restore_url"] else None,
        "health": urls["health"].path if urls["health"] else None,
        "port": urls["url"].port if urls["url"] else None,
        "park": args.park,
        "action_timeout_s": args.timeout,
        "start_s": args.start,
        "gpu": args.gpu,
        "priority": args.priority,
        "min_residency_s": args.min_residency,
        "wait_s": args.wait,
        "grace_s": args.grace,
    }
    server = {key: value for key, value in given.items() if value is not None}
    name = args.name or args.unit or args.container or Path(command[0]).name
    config = json.dumps({"listen": args.listen, "servers": {name: server}})
    memory = os.memfd_create("gateway")
    os.write(memory, config.encode())
    os.lseek(memory, 0, os.SEEK_SET)
    os.dup2(memory, 0)  # its configuration; the program has no input
    endpoint = ["--endpoint", args.endpoint] if args.endpoint else []
    os.execv(sys.executable, [sys.executable, "-m", *GATEWAY, *endpoint])


def _action(args: argparse.Namespace) -> Action | None:
    """Return what frees a running program; None where it is ended. Exits with 2 for options that
    the action has no use for."""
    chosen, server = args.on_evict, SERVERS.get(args.on_evict)
    takes = {"end": (), "stop": (), CHECKPOINT: ("timeout", "park"), "http": OPTIONS}
    for option in OPTIONS:
        given = getattr(args, option) not in (None, False)
        if given and option not in takes.get(chosen, ("url", "allow_remote", "timeout", "park")):
            flag = option.replace("_", "-")
            args.parser.error(f"--{flag} has no effect with --on-evict {chosen}")
    timeout_s = TIMEOUT_S if args.timeout is None else args.timeout
    if server is not None:
        return server(_url(args, "url", server.default_url), timeout_s)
    if chosen == CHECKPOINT:
        return CheckpointAction(CudaDriver(), timeout_s)
    if chosen != "http":
        return None
    if args.url is None:
        args.parser.error("--on-evict http needs --url, the URL that frees")
    restoring = None if args.restore_url is None else Request(_url(args, "restore_url"))
    return HttpAction(Request(_url(args, "url")), restoring, timeout_s)


def _service(args: argparse.Namespace) -> Service | None:
    if args.unit:
        return find_unit(args.unit)
    return find_container(args.container, args.grace) if args.container else None


def _control(args: argparse.Namespace) -> Control | None:
    if args.control is None:
        return None
    try:
        return Control(args.control)
    except OSError as error:
        parser: argparse.ArgumentParser = args.parser
        parser.error(f"--control {args.control}: not an open socket: {error.strerror}")


def _url(args: argparse.Namespace, option: str, default: str = "") -> str:
    try:
        return checked_url(getattr(args, option) or default, remote=args.allow_remote)
    except ValueError as error:
        parser: argparse.ArgumentParser = args.parser
        parser.error(f"--{option.replace('_', '-')}: {error}")


async def run_leased(spec: RunSpec, endpoint: str | None) -> int:
    """Return the program's exit code. Raises the typed error of a lease that was not granted,
    ArbiterUnreachable, CheckpointUnsupported, ConfigError; with a record also CalibrationFailed."""
    program = shutil.which(spec.command[0]) if spec.service is None else ""
    if program is None:
        say(f"{spec.command[0]}: not found, or not a file that may be executed")
        return NOT_FOUND
    if spec.action is not None:
        spec.action.check()
    if spec.tends_orphans:
        adopt_orphans()
    async with AsyncClient(
        f"vramctl run {spec.consumer}"[:NAME_MAX_CHARS], endpoint=endpoint
    ) as client:
        if spec.action is not None:
            status = await client.ask(Status())  # the page of all GPUs
            check_gpus(spec.gpu, status.gpus)
        supervisor = Supervisor(spec, client, program)
        await supervisor.acquire()
        if not await supervisor.still_wanted():
            return 0
        with Forwarding(supervisor.asked_to_end) as signals:
            try:
                await supervisor.start(signals)
            except OSError as error:
                say(f"{program}: {error.strerror}")
                return NOT_STARTED
            code = await supervisor.until_ended()
    return code if code >= 0 else 128 - code


def check_gpus(wanted: str, gpus: Sequence[GpuView]) -> None:
    """Raises ConfigError where a program that lives on could be granted another GPU later."""
    if wanted == "any" and len(gpus) > 1:
        raise ConfigError(
            f"there are {len(gpus)} GPUs, and the program must return to the one it was started on",
            hint="name one with --gpu",
        )
