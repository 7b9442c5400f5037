"""`vramctl`: hands the arguments to the quick commands, or to the full command line. Imports nothing that costs."""

import sys

from clients.cli import quick


def main() -> None:
    """Entry point. Exit codes: 0 done, 1 the answer is no or an error, 2 wrong usage, 3 the arbiter cannot be reached."""
    try:
        code = quick.try_run(sys.argv[1:])
        if code is None:
            from clients.cli.app import run_app

            code = run_app(sys.argv[1:])
        sys.stdout.flush()
    except BrokenPipeError:  # `vramctl history | head`
        sys.stderr.close()
        code = quick.OK
    except KeyboardInterrupt:
        code = 130
    sys.exit(code)
