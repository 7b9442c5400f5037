"""`vram-arbiter`: parse, check, run. Everything else is in `daemon`."""

import argparse
import asyncio
import faulthandler
import os
import sys
from collections.abc import Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from vram_arbiter.schemas.errors import (
    AlreadyRunning,
    ConfigError,
    InternalError,
    JournalUnavailable,
    NoGpu,
    ProbeFailed,
    VramError,
)
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.heap import give_back_freed_memory, without_collections
from vram_arbiter.schemas.runtime.version import add_version, version
from vram_arbiter.schemas.urls import http_address

if TYPE_CHECKING:
    from vram_arbiter.schemas.config.arbiter import ArbiterConfig

EXIT_USAGE, EXIT_ALREADY_RUNNING, EXIT_NO_GPU, EXIT_NO_DISK, EXIT_DEFECT = 2, 3, 4, 5, 70
CONFIG_NAME = "arbiter.yaml"

_EPILOG = """\
exit codes:
  0   stopped by SIGTERM or SIGINT (leases stay with their holders), or --check-config found nothing
  2   wrong flags or configuration
  3   another arbiter serves this socket or uses this state folder
  4   no GPU: no NVIDIA driver, or none that it drives (--gpu fake:8GiB simulates one)
  5   the disk of the state folder is full, failing or read-only: worth another try
  74  the output cannot be written (a full disk behind a redirection)
  70  a defect: the core's state became invalid; the log says how, a restart recovers the leases

signals:
  SIGTERM, SIGINT  stop; leases stay with their holders
  SIGHUP           read the configuration file again; a wrong one is refused, and the former one
                   stays in force

environment:
  VRAM_ARBITER_ENDPOINT   endpoint, if neither --endpoint nor wire.endpoint is given
  VRAM_ARBITER_RUNTIME    folder of the sockets and of the simulated GPU (else RUNTIME_DIRECTORY,
                          XDG_RUNTIME_DIR/vram-arbiter, /run/user/UID/vram-arbiter,
                          for root /run/vram-arbiter)
"""


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog="vram-arbiter",
        description="Leases GPU memory to processes: one daemon per machine, no configuration "
        "needed.",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    made.add_argument(
        "--config",
        metavar="FILE",
        type=Path,
        help="YAML file; every key is explained in configs/arbiter.yaml (default: arbiter.yaml in "
        "CONFIGURATION_DIRECTORY)",
    )
    made.add_argument(
        "--gpu",
        metavar="SOURCE",
        help="auto (default), nvml: the NVIDIA GPUs, unified: Jetson and GB10; fake:8GiB: a "
        "simulated GPU in the runtime folder; fake:FOLDER: that one",
    )
    made.add_argument("--endpoint", metavar="URL", help="where to listen, ipc:///absolute/path")
    made.add_argument("--state-dir", metavar="DIR", help="folder of journal and history")
    made.add_argument(
        "--group", metavar="GROUP", help="Unix group that may connect and hold leases"
    )
    made.add_argument(
        "--operators-group",
        metavar="GROUP",
        help="Unix group that may evict, pin and drain; without --group it may also connect",
    )
    made.add_argument(
        "--guests-group", metavar="GROUP", help="Unix group of --group that may only use and look"
    )
    made.add_argument(
        "--http",
        metavar="ADDRESS:PORT",
        type=loopback,
        help="start a vram-observer beside the daemon, with status page and /metrics on loopback, "
        "e.g. 127.0.0.1:9870; it ends with the daemon",
    )
    made.add_argument(
        "--log-format", choices=("human", "json"), help="human (default) or one JSON object a line"
    )
    made.add_argument(
        "--log-level", choices=("debug", "info", "warning", "error"), help="info (default)"
    )
    made.add_argument(
        "--check-config", action="store_true", help="check flags and configuration, then exit"
    )
    add_version(made)
    return made


def loopback(text: str) -> str:
    """Parse the address of the page. Raises ArgumentTypeError."""
    try:
        address = http_address(text)
    except ValueError as error:
        raise argparse.ArgumentTypeError(str(error)) from None
    if not address.loopback:
        raise argparse.ArgumentTypeError(
            f"{address} is not a loopback address: write it and a token_file to observer.yaml, and "
            "start vram-observer"
        )
    return str(address)


def config_of_service(environ: Mapping[str, str]) -> Path | None:
    """`arbiter.yaml` in the configuration folder that systemd names, if there is one."""
    folder = environ.get("CONFIGURATION_DIRECTORY", "").split(":")[0]
    found = Path(folder) / CONFIG_NAME
    return found if folder and found.exists() else None


def effective_config(flags: argparse.Namespace, file: Path | None) -> "ArbiterConfig":
    """Return the file's configuration with the flags over it. Raises ConfigError."""
    from vram_arbiter.schemas.config.arbiter import ArbiterConfig, load_config

    config = ArbiterConfig()
    if file is not None:
        from vram_arbiter.schemas.yamltext import read_text

        text = read_text(file, hint="--config needs a readable YAML file", trusted=True)
        config = load_config(text, str(file))
    values = config.model_dump()
    for section, key, value, flag in (
        ("gpu", "source", flags.gpu, "--gpu"),
        ("wire", "endpoint", flags.endpoint, "--endpoint"),
        ("state", "dir", flags.state_dir, "--state-dir"),
        ("wire", "group", flags.group, "--group"),
        ("wire", "operators_group", flags.operators_group, "--operators-group"),
        ("wire", "guests_group", flags.guests_group, "--guests-group"),
        ("log", "format", flags.log_format, "--log-format"),
        ("log", "level", flags.log_level, "--log-level"),
    ):
        if value is None:
            continue
        values[section][key] = value
        try:
            ArbiterConfig.model_validate(values)
        except ValueError as error:
            raise ConfigError(
                f"{flag}: {_first_problem(error)}", hint="see vram-arbiter --help"
            ) from error
    return ArbiterConfig.model_validate(values)


def _first_problem(error: ValueError) -> str:
    from pydantic import ValidationError

    if isinstance(error, ValidationError):
        return error.errors(include_url=False)[0]["msg"].removeprefix("Value error, ")
    return str(error)


def exit_code_of(error: VramError) -> int:
    match error:
        case AlreadyRunning():
            return EXIT_ALREADY_RUNNING
        case NoGpu() | ProbeFailed():
            return EXIT_NO_GPU
        case JournalUnavailable():
            return EXIT_NO_DISK
        case InternalError():
            return EXIT_DEFECT
        case _:
            return EXIT_USAGE


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code; prints errors of the operator as one line without a traceback."""
    flags = parser().parse_args(argv)
    # the manager's watchdog kills by SIGABRT: the log then says where the daemon was stuck
    faulthandler.enable()
    # the search for pydantic's plugins reads files of every installed distribution
    os.environ.setdefault("PYDANTIC_DISABLE_PLUGINS", "__all__")
    try:
        file = flags.config or config_of_service(os.environ)
        with without_collections():  # modules stay
            config = effective_config(flags, file)
            # late: --help and --version need none of it
            from vram_arbiter.arbiter.daemon import Daemon
            from vram_arbiter.arbiter.host.process import new_loop
            from vram_arbiter.arbiter.log import set_up_logging, write_in_thread
            from vram_arbiter.arbiter.places import find_places
            from vram_arbiter.arbiter.reload import Source

        places = find_places(config, os.environ, os.getuid())
        if flags.check_config:
            print(
                f"{file or 'built-in configuration'}: ok (would serve {places.endpoint}, "
                f"gpu {config.gpu.source})"
            )
            return 0
        set_up_logging(config.log.format, config.log.level)
        give_back_freed_memory()
        source = Source(
            lambda: flags.config or config_of_service(os.environ), partial(effective_config, flags)
        )

        async def serve() -> int:
            return await Daemon(config, os.environ, version(), source, flags.http).run()

        close_log = write_in_thread()
        try:
            with asyncio.Runner(loop_factory=new_loop) as runner:
                return runner.run(serve())
        finally:
            close_log()
    except VramError as error:
        terminal.complain("vram-arbiter", error)
        return exit_code_of(error)


if __name__ == "__main__":
    sys.exit(main())
