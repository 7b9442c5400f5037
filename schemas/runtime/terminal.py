"""How a program of the command line ends where its surroundings end it: Ctrl-C, a reader that left
(`| head`), a full output device, and a package that this installation does not have.

None of them is a defect, so there is no traceback but one line at most. The first two have the
shell's exit codes, 128 + the signal.
"""

import errno
import os
import select
import signal
import sys
from collections.abc import Callable
from functools import wraps

from vram_arbiter.schemas.runtime.printable import printable_lines

INTERRUPTED = 128 + signal.SIGINT
READER_LEFT = 128 + signal.SIGPIPE
NO_ROOM = 74
"""EX_IOERR: what the program has to say, or to write, cannot be written."""
NOT_INSTALLED = 2

_NO_ROOM = frozenset((errno.ENOSPC, errno.EDQUOT, errno.EFBIG, errno.EIO, errno.EROFS))


def program[**P](main: Callable[P, int]) -> Callable[P, int]:
    """Let `main`, which returns the exit code, end quietly. A pipe of its own that breaks is its
    error as before."""

    @wraps(main)
    def ended(*arguments: P.args, **named: P.kwargs) -> int:
        try:
            try:
                code = main(*arguments, **named)
            finally:
                sys.stdout.flush()  # also after `--help`, which ends by SystemExit
        except BrokenPipeError:
            if not _reader_left():
                raise
            silence()
            return READER_LEFT
        except KeyboardInterrupt:
            return INTERRUPTED
        except OSError as error:
            return no_room(program_name(), error)
        except ModuleNotFoundError as error:
            return not_installed(program_name(), error)
        return code

    return ended


def complain(name: str, error: BaseException) -> None:
    """Say on stderr why a program ends; what the error quotes is escaped."""
    print(f"{name}: {printable_lines(error)}", file=sys.stderr)


def no_room(name: str, error: OSError) -> int:
    """Say that an output cannot be written and return the exit code. Raises the error if it is any
    other."""
    if error.errno not in _NO_ROOM:
        raise error
    silence()
    what = f"{error.filename}" if error.filename else "the output"
    print(f"{name}: {what} cannot be written: {error.strerror}", file=sys.stderr)
    return NO_ROOM


def not_installed(name: str, error: ModuleNotFoundError) -> int:
    """Say which extra brings a package and return the exit code. Raises the error if none does."""
    from vram_arbiter.schemas.runtime.extras import explained

    problem = explained("this command", error)
    if problem is None:
        raise error
    print(f"{name}: {problem}", file=sys.stderr)
    return NOT_INSTALLED


def silence() -> None:
    """Nothing more can be printed: the interpreter's own last flush must not fail on it again."""
    os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def program_name() -> str:
    """What the program was started as: `vram-runner`, or `runner` for `python -m
    vram_arbiter.runner`."""
    path = sys.argv[0] if sys.argv else ""
    folder, name = os.path.split(path)
    return os.path.basename(folder) if name == "__main__.py" else name or "python"


def _reader_left() -> bool:
    poll = select.poll()
    poll.register(sys.stdout.fileno(), 0)
    return any(events & select.POLLERR for _, events in poll.poll(0))
