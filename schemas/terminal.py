"""How a program of the command line ends when whoever reads it has had enough: Ctrl-C, or a reader that left (`| head`).

Both are no defects, so there is no traceback: the exit codes are the shell's, 128 + the signal.
"""

import os
import select
import signal
import sys
from collections.abc import Callable
from functools import wraps

INTERRUPTED = 128 + signal.SIGINT
READER_LEFT = 128 + signal.SIGPIPE


def program[**P](main: Callable[P, int]) -> Callable[P, int]:
    """Let `main`, which returns the exit code, end quietly by both. A pipe of its own that breaks is its error as before."""

    @wraps(main)
    def ended(*arguments: P.args, **named: P.kwargs) -> int:
        try:
            code = main(*arguments, **named)
            sys.stdout.flush()
        except BrokenPipeError:
            if not _reader_left():
                raise
            # the interpreter flushes once more
            os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
            return READER_LEFT
        except KeyboardInterrupt:
            return INTERRUPTED
        return code

    return ended


def _reader_left() -> bool:
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))
