"""The command line of `vramctl`: parse, call, print. What a command does is in the module that it imports when it runs."""

import asyncio
import shutil
from collections.abc import Callable, Sequence
from typing import Annotated

import typer

from vram_arbiter.clients.cli import quick
from vram_arbiter.schemas.defaults import NAME_MAX_CHARS, REASON_MAX_CHARS
from vram_arbiter.schemas.errors import ArbiterUnreachable, UntrustedServer, VramError
from vram_arbiter.schemas.runtime.version import DISTRIBUTION, version

_EPILOG = (
    "Exit codes: 0 done · 1 the answer is no, or an error · 2 wrong usage · 3 the arbiter cannot be reached · "
    "74 the output cannot be written. "
    "Sizes are printed in GiB/MiB (1024-based); written ones may be 8GiB, 5.3GB, 450MiB. "
    "VRAM_ARBITER_ENDPOINT or VRAM_ARBITER_RUNTIME say where the arbiter serves; VRAM_ARBITER_SERVER_USERS names users who may serve it "
    "beside root, yourself and vram-arbiter."
)

CONTEXT = {
    "help_option_names": ["-h", "--help"],
    "max_content_width": shutil.get_terminal_size().columns,  # click stops at 80 otherwise
}
app = typer.Typer(
    name="vramctl",
    context_settings=CONTEXT,
    epilog=_EPILOG,
    no_args_is_help=True,
    add_completion=False,
    rich_markup_mode=None,
    pretty_exceptions_enable=False,
)


def _one_line(most: int, *, needed: bool) -> Callable[[str], str]:
    """A callback of typer's: text as the wire takes it, said in words of people and before anybody is asked."""

    def check(written: str) -> str:
        if needed and not written.strip():
            raise typer.BadParameter("it must not be empty")
        if len(written) > most or any(char < " " or char == "\x7f" for char in written):
            raise typer.BadParameter(f"it must be one line of at most {most} characters")
        return written

    return check


Endpoint = Annotated[
    str | None, typer.Option(help="Where the arbiter serves.", envvar="VRAM_ARBITER_ENDPOINT")
]
AsJson = Annotated[
    bool, typer.Option("--json", help="Print the reply as JSON (the shapes of schemas.wire).")
]


def run_app(arguments: Sequence[str]) -> int:
    """Run one command and return its exit code."""
    if (
        "--version" in arguments[:2]
    ):  # of a command too; what follows `run` and its flags is another program's
        print(f"{DISTRIBUTION} {version()}")
        return quick.OK
    as_json = (
        "--json" in arguments and arguments[0] != "run"
    )  # what follows `run` is another program's
    try:
        result = app(args=list(arguments), prog_name="vramctl", standalone_mode=False)
    except typer.Abort:
        return 130
    except SystemExit as end:
        return int(end.code or 0)
    except (ArbiterUnreachable, UntrustedServer) as error:
        quick.complain(error.to_wire(), as_json=as_json)
        return quick.UNREACHABLE
    except VramError as error:
        quick.complain(error.to_wire(), as_json=as_json)
        return quick.NO
    except Exception as error:
        # click's own usage errors know how to show themselves; anything else is a defect and keeps its traceback
        show: Callable[[], None] | None = getattr(error, "show", None)
        if show is None:
            raise
        show()
        return int(getattr(error, "exit_code", quick.USAGE))
    return int(result or 0)


@app.callback()
def options(
    version: Annotated[bool, typer.Option("--version", help="Show the version and exit.")] = False,
) -> None:
    """See and use the VRAM arbiter: which lease holds which bytes, why a request waits, and leases for any program."""


@app.command()
def status(as_json: AsJson = False, endpoint: Endpoint = None) -> None:
    """Cards, leases and the queue."""
    raise typer.Exit(quick.status(as_json=as_json, endpoint=endpoint))


@app.command()
def why(
    consumer: Annotated[
        str,
        typer.Argument(
            help="A consumer or a lease, as `status` shows it.",
            callback=_one_line(NAME_MAX_CHARS, needed=True),
        ),
    ],
    as_json: AsJson = False,
    endpoint: Endpoint = None,
) -> None:
    """Why CONSUMER is not running: who blocks it, how many bytes, on which condition, what happens next, when.

    Exits 1 if it neither holds nor waits for a lease.
    """
    raise typer.Exit(quick.why(consumer, as_json=as_json, endpoint=endpoint))


@app.command()
def history(
    as_json: AsJson = False,
    endpoint: Endpoint = None,
    limit: Annotated[
        int, typer.Option("--limit", "-n", min=1, max=5000, help="At most so many events.")
    ] = 50,
    after: Annotated[
        int | None,
        typer.Option(min=0, help="The first events after this number (default: the newest)."),
    ] = None,
    since: Annotated[
        str | None, typer.Option(help="Since 90s, 10m, 2h or 1d ago, 14:30, or 2026-11-21 14:30.")
    ] = None,
    consumer: Annotated[
        list[str] | None,
        typer.Option(
            "--consumer", "-c", help="Only about this consumer; may be given several times."
        ),
    ] = None,
    kind: Annotated[
        list[str] | None, typer.Option(help="Only this kind; may be given several times.")
    ] = None,
    follow: Annotated[
        bool,
        typer.Option("--follow", "-f", help="Then every further one as it happens, until Ctrl-C."),
    ] = False,
) -> None:
    """What happened: grants, evictions, verdicts, with their reasons. With --follow --json one JSON object a line."""
    from vram_arbiter.clients.cli import history as past

    try:
        since_wall_s = None if since is None else past.since_now(since)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    wanted = past.Wanted(kind or (), consumer or (), since_wall_s, limit, after)
    if follow:
        raise typer.Exit(asyncio.run(past.follow(wanted, as_json=as_json, endpoint=endpoint)))
    raise typer.Exit(past.history(wanted, as_json=as_json, endpoint=endpoint))


@app.command()
def watch(
    endpoint: Endpoint = None,
    events: Annotated[int, typer.Option(min=0, max=200, help="Events shown below the table.")] = 12,
) -> None:
    """Live view of leases and events; plain lines of events where the output is no terminal. Ctrl-C ends it."""
    from vram_arbiter.clients.cli.watch import watch as live

    raise typer.Exit(asyncio.run(live(endpoint, events)))


Target = Annotated[
    str,
    typer.Argument(
        help="A lease (L3-17), or a consumer that has exactly one.",
        callback=_one_line(NAME_MAX_CHARS, needed=True),
    ),
]
Because = Annotated[
    str,
    typer.Option(
        "--reason",
        "-r",
        help="Why; kept in history with your name.",
        callback=_one_line(REASON_MAX_CHARS, needed=True),
    ),
]
Remark = Annotated[
    str,
    typer.Option(
        "--reason",
        "-r",
        help="Why, if there is more to say; kept in history with your name.",
        callback=_one_line(REASON_MAX_CHARS, needed=False),
    ),
]


@app.command()
def evict(
    target: Target, reason: Because, as_json: AsJson = False, endpoint: Endpoint = None
) -> None:
    """Ask a holder to leave. In use, it finishes first; a pinned one is refused. Operators only."""
    raise typer.Exit(
        quick.by_hand(
            "evict", {"target": target, "reason": reason}, as_json=as_json, endpoint=endpoint
        )
    )


@app.command()
def pin(
    target: Target, reason: Because, as_json: AsJson = False, endpoint: Endpoint = None
) -> None:
    """Nobody makes this lease leave until it is unpinned. Operators only."""
    raise typer.Exit(
        quick.by_hand(
            "pin", {"target": target, "reason": reason}, as_json=as_json, endpoint=endpoint
        )
    )


@app.command()
def unpin(
    target: Target, reason: Remark = "", as_json: AsJson = False, endpoint: Endpoint = None
) -> None:
    """Undo an operator's pin. Operators only."""
    raise typer.Exit(
        quick.by_hand(
            "unpin", {"target": target, "reason": reason}, as_json=as_json, endpoint=endpoint
        )
    )


@app.command()
def drain(reason: Because, as_json: AsJson = False, endpoint: Endpoint = None) -> None:
    """No new grants until `vramctl resume`; what is held is kept. Outlives the daemon, not the machine. Operators only."""
    raise typer.Exit(quick.by_hand("drain", {"reason": reason}, as_json=as_json, endpoint=endpoint))


@app.command()
def resume(reason: Remark = "", as_json: AsJson = False, endpoint: Endpoint = None) -> None:
    """Grant again after a drain. Operators only."""
    raise typer.Exit(
        quick.by_hand("resume", {"reason": reason}, as_json=as_json, endpoint=endpoint)
    )


@app.command(name="release-dead")
def release_dead(
    target: Target, reason: Because, as_json: AsJson = False, endpoint: Endpoint = None
) -> None:
    """Give up the lease of a holder that is not heard of, before its ttl is over; its bytes are measured gone as ever.

    Refused in use, and for a holder that is heard of. Operators only.
    """
    raise typer.Exit(
        quick.by_hand(
            "release_dead", {"target": target, "reason": reason}, as_json=as_json, endpoint=endpoint
        )
    )


@app.command(context_settings={"allow_interspersed_args": False})
def run(
    command: Annotated[
        list[str], typer.Argument(help="The program and its arguments, after `--`.")
    ],
    vram: Annotated[str, typer.Option(help="Bytes that the program needs, e.g. 5GiB.")],
    name: Annotated[
        str | None, typer.Option(help="Consumer's name (default: the program's).")
    ] = None,
    gpu: Annotated[str, typer.Option(help="uuid, index or any.")] = "any",
    priority: Annotated[
        int,
        typer.Option(
            min=0, max=100, help="Below the 50 of other leases: a robot's models go first."
        ),
    ] = 40,
    wait: Annotated[
        float | None, typer.Option(min=0, help="Give up after so many seconds (default: never).")
    ] = None,
    exclusive: Annotated[
        bool, typer.Option("--exclusive", help="No other model on that GPU.")
    ] = False,
    pin: Annotated[bool, typer.Option("--pin", help="Never end the program to make room.")] = False,
    on_revoke: Annotated[
        str,
        typer.Option(
            help="priority: end the program for a request of a higher priority, or for an operator; others wait. "
            "term: end it for any request. pin: as --pin."
        ),
    ] = "priority",
    grace: Annotated[
        float | None,
        typer.Option(
            min=0, help="Seconds from SIGTERM to SIGKILL (default: as long as the program takes)."
        ),
    ] = None,
    endpoint: Endpoint = None,
) -> None:
    """Run a program that knows nothing of the arbiter under a lease: `vramctl run --vram 5GiB -- python train.py`.

    The program sees VRAM_LEASE_ID, VRAM_LEASE_TOKEN and VRAM_LEASE_GPU, and CUDA_VISIBLE_DEVICES unless that was set;
    signals are passed on. Two programs that do not fit together run one after the other. At the end the measured peak is
    said. Exits with the program's code (128+n if signal n ended it), 1 if no lease was granted, 3 without an arbiter,
    126/127 if it cannot be started.
    """
    from pydantic import ValidationError

    from vram_arbiter.clients.cli.run import ON_REVOKE, RunSpec, lease_spec, run_leased
    from vram_arbiter.schemas.sizes import parse_bytes

    chosen = "pin" if pin else on_revoke
    if chosen not in ON_REVOKE:
        raise typer.BadParameter(f"--on-revoke is one of {', '.join(ON_REVOKE)}, not {on_revoke!r}")
    if pin and on_revoke == "term":
        raise typer.BadParameter("--pin and --on-revoke term exclude each other")
    try:
        size = parse_bytes(vram)
    except ValueError as error:
        raise typer.BadParameter(str(error)) from error
    spec = RunSpec(command, name, size, gpu, priority, wait, exclusive, chosen, grace)
    try:
        lease_spec(spec)
    except ValidationError as error:
        problem = error.errors()[0]
        option = "--gpu" if problem["loc"] == ("gpu",) else "--name"
        raise typer.BadParameter(f"{option}: {problem['msg']}, got {problem['input']!r}") from error
    raise typer.Exit(asyncio.run(run_leased(spec, endpoint)))


@app.command()
def doctor(as_json: AsJson = False, endpoint: Endpoint = None) -> None:
    """Check this installation: where the six packages come from, the endpoint, the daemon's health, its GPUs.

    Exits 0 if all is well, 1 on any finding (a foreign package, a journal that cannot be written, a drained daemon, a GPU that cannot be
    read or is under pressure), 3 if the arbiter cannot be reached.
    """
    from vram_arbiter.clients.cli.doctor import doctor as examine

    raise typer.Exit(examine(as_json=as_json, endpoint=endpoint))


_PASSED_ON = {"allow_extra_args": True, "ignore_unknown_options": True, "help_option_names": []}


@app.command(context_settings=_PASSED_ON)
def replay(context: typer.Context) -> None:
    """Run a recorded event log through the engine again: the same decisions, byte for byte? What would another policy have done?

    See `vramctl replay --help`.
    """
    from vram_arbiter.clients.cli.engine import run as start

    raise typer.Exit(start(["replay", *context.args]))


@app.command(context_settings=_PASSED_ON)
def simulate(context: typer.Context) -> None:
    """Run a scenario through the engine, under one policy or several side by side; see `vramctl simulate --help`."""
    from vram_arbiter.clients.cli.engine import run as start
    from vram_arbiter.clients.cli.engine import with_scenario

    raise typer.Exit(start(["simulate", *with_scenario(context.args)]))


@app.command(context_settings=_PASSED_ON)
def demo(context: typer.Context) -> None:
    """Run find → navigate → grab on a simulated arm inside 8 GiB (needs the full install); see `vramctl demo --help`."""
    from vram_arbiter.clients.cli.demo import demo as show

    inner = typer.Typer(add_completion=False, rich_markup_mode=None, pretty_exceptions_enable=False)
    inner.command(context_settings=CONTEXT)(show)
    raise typer.Exit(
        int(inner(args=context.args, prog_name="vramctl demo", standalone_mode=False) or 0)
    )
