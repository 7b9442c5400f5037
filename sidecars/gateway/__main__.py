"""`vram-gateway`: parse, check, run. Everything else is in `gateway`."""

import argparse
import asyncio
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final

from vram_arbiter.clients.cli import arguments
from vram_arbiter.schemas.config.gateway import GatewayConfig, load_gateway
from vram_arbiter.schemas.errors import ArbiterUnreachable, ConfigError, UntrustedServer, VramError
from vram_arbiter.schemas.runtime import logging as logs
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.runtime.extras import need
from vram_arbiter.schemas.runtime.telemetry.commands import command
from vram_arbiter.schemas.runtime.version import add_version
from vram_arbiter.schemas.yamltext import read_text
from vram_arbiter.sidecars.gateway import imports, setup

PROGRAM: Final = "vram-gateway"
EXIT_FAILED, EXIT_USAGE, EXIT_UNREACHABLE = 1, 2, 3

_EPILOG = """\
exit codes:
  0   stopped by SIGTERM or SIGINT, or nothing wrong was found
  1   the arbiter refuses it; `import` left something out; `demo`: a request failed
  2   wrong flags or configuration, or the extra `gateway` is not installed
  3   no arbiter answers
"""


def parser() -> argparse.ArgumentParser:
    made = argparse.ArgumentParser(
        prog=PROGRAM,
        description="Model servers behind one address, each awake when a request needs it "
        "(docs/reference/gateway.md).",
        epilog=_EPILOG,
        formatter_class=argparse.RawDescriptionHelpFormatter,
    )
    add_version(made)
    commands = made.add_subparsers(dest="command", metavar="COMMAND", required=True)
    serve = commands.add_parser("serve", help="serve until SIGTERM; prints its address")
    serve.add_argument(
        "--config", metavar="FILE", type=Path, required=True, help="YAML file; - for stdin"
    )
    serve.add_argument("--listen", metavar="ADDRESS:PORT", help="wins over `listen` of the file")
    serve.add_argument(
        "--check", action="store_true", help="check the configuration and its files, and exit"
    )
    serve.add_argument("--log-format", choices=logs.FORMS, default="human")
    arguments.add_endpoint(serve)
    serve.set_defaults(run=_serve)
    convert = commands.add_parser("import", help="convert a configuration of llama-swap")
    imports.add_arguments(convert)
    convert.set_defaults(run=imports.run)
    begin = commands.add_parser(
        "setup", help="find GPUs and model servers, write the configuration, start the service"
    )
    setup.add_arguments(begin)
    arguments.add_endpoint(begin)
    begin.set_defaults(run=setup.run)
    show = commands.add_parser("demo", help="two stand-in servers take turns on a simulated GPU")
    show.add_argument("--no-browser", action="store_true", help="print the page's address alone")
    show.set_defaults(run=_demo)
    return made


def read_config(path: Path, listen: str | None) -> GatewayConfig:
    """Return the file's configuration with the flag over it. Raises ConfigError."""
    if str(path) == "-":
        text = sys.stdin.read()
    else:
        text = read_text(path, hint="--config needs a readable YAML file", trusted=True)
    config = load_gateway(text, str(path))
    if listen is None:
        return config
    try:
        return GatewayConfig.model_validate({**config.model_dump(), "listen": listen})
    except ValueError as error:
        raise ConfigError(f"--listen: {error}", hint=f"see {PROGRAM} --help") from error


def _serve(args: argparse.Namespace) -> int:
    config = read_config(args.config, args.listen)
    need(PROGRAM, "aiohttp", extra="gateway")
    from vram_arbiter.sidecars.gateway import gateway, program

    config = program.sized(config)
    if args.check:
        gateway.check(config)
        print(f"{len(config.servers)} servers behind {config.listen}")
        return 0
    logs.set_up(PROGRAM, "info", args.log_format, f"{PROGRAM}: %(levelname)s %(message)s")
    with command(PROGRAM, "serve", serves=True):
        asyncio.run(gateway.run(config, args.endpoint))
    return 0


def _demo(args: argparse.Namespace) -> int:
    need(PROGRAM, "aiohttp", extra="gateway")
    from vram_arbiter.sidecars.gateway import demo

    return demo.run(browser=not args.no_browser)


@terminal.program
def main(argv: Sequence[str] | None = None) -> int:
    """Returns the exit code; prints errors of the operator as one line without a traceback."""
    args = parser().parse_args(argv)
    try:
        run: Callable[[argparse.Namespace], int] = args.run
        return run(args)
    except VramError as error:
        terminal.complain(PROGRAM, error)
        match error:
            case ConfigError():
                return EXIT_USAGE
            case ArbiterUnreachable() | UntrustedServer():
                return EXIT_UNREACHABLE
            case _:
                return EXIT_FAILED


if __name__ == "__main__":
    sys.exit(main())
