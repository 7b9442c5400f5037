"""`vramctl`: hands the arguments to the quick commands, or to the full command line. Imports nothing that costs."""

import sys

from vram_arbiter.clients.cli import quick

TELEMETRY_S = 1.0  # a person waits for the prompt: a collector that is away costs no more than this


def main() -> None:
    """Entry point. Exit codes: 0 done, 1 the answer is no or an error, 2 wrong usage, 3 the arbiter cannot be reached, 74 no room to write."""
    try:
        try:
            code = quick.try_run(sys.argv[1:])
            if code is None:
                code = _in_full(sys.argv[1:])
        finally:
            sys.stdout.flush()
    except BrokenPipeError:  # `vramctl history | head`
        sys.stderr.close()
        code = quick.OK
    except KeyboardInterrupt:
        code = 130
    except OSError as error:
        from vram_arbiter.schemas.runtime import terminal

        code = terminal.no_room("vramctl", error)
    except ModuleNotFoundError as error:
        from vram_arbiter.schemas.runtime import terminal

        code = terminal.not_installed("vramctl", error)
    sys.exit(code)


def _in_full(arguments: list[str]) -> int:
    """A command with everything that it may import, as a span where telemetry is asked for."""
    from vram_arbiter.clients.cli.app import run_app
    from vram_arbiter.schemas.errors import ConfigError
    from vram_arbiter.schemas.runtime import terminal
    from vram_arbiter.schemas.runtime.telemetry.commands import command

    try:
        with command("vramctl", arguments[0] if arguments else "", flush_s=TELEMETRY_S) as running:
            running.code = run_app(arguments)
    except ConfigError as error:
        terminal.complain("vramctl", error)
        return quick.USAGE
    return running.code
