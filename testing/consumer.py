"""A process of a test's own that holds a lease: a program, or a function of the test's file."""

import contextlib
import os
import signal
import subprocess
import sys
import tempfile
from collections.abc import Callable, Sequence
from typing import Any, Final

from vram_arbiter.clients.cli.status import all_pages
from vram_arbiter.clients.net.request import checked
from vram_arbiter.schemas.codec import from_map
from vram_arbiter.schemas.fakegpu import FOLDER_VARIABLE
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import LeaseView
from vram_arbiter.testing import call
from vram_arbiter.testing.daemon import ArbiterProcess
from vram_arbiter.testing.waiting import WITHIN_S, eventually

GONE: Final = "gone"
"""State of a consumer without a lease."""
OUTPUT_MAX_BYTES: Final = 1 << 20
type Program = Sequence[str] | Callable[..., object]


class Consumer:
    """A process whose lease has the consumer's name `name`. It leads a session of its own, which
    ends with it.

    `program`: words of a command, or a function at the top level of a file, with `arguments` and
    `named` that JSON can express. It finds the daemon and the simulated GPU by its environment, and
    in this process's interpreter what this process can import.
    """

    def __init__(
        self, arbiter: ArbiterProcess, name: str, program: Program, *arguments: Any, **named: Any
    ) -> None:
        environ = arbiter.environ | {FOLDER_VARIABLE: str(arbiter.gpu_folder)}
        if callable(program):
            program = call.command(program, *arguments, **named)
        if program[0] == sys.executable:
            environ["PYTHONPATH"] = os.pathsep.join(filter(None, sys.path))
        self.name = name
        self._arbiter = arbiter
        self._printed = tempfile.TemporaryFile()  # noqa: SIM115  it lives as long as the process
        self.process = subprocess.Popen(
            program, env=environ, stdin=subprocess.PIPE, stdout=self._printed,
            stderr=subprocess.STDOUT, start_new_session=True,
        )  # fmt: skip
        self.pid = self.process.pid

    @property
    def output(self) -> str:
        """What it has printed."""
        return os.pread(self._printed.fileno(), OUTPUT_MAX_BYTES, 0).decode(errors="replace")

    @property
    def lease(self) -> LeaseView | None:
        """Its newest lease, as `vramctl status` shows it. Raises ArbiterUnreachable."""
        reply = checked(all_pages(self._arbiter.endpoint))
        leases = [one for one in from_map(StatusReply, reply).leases if one.consumer == self.name]
        return leases[-1] if leases else None

    @property
    def state(self) -> str:
        """State of its lease; GONE without one."""
        return GONE if (lease := self.lease) is None else lease.state

    def reached(self, state: str, within_s: float = WITHIN_S) -> None:
        """Wait until its lease has this state. Raises AssertionError, and RuntimeError with the
        output if the process ends first."""

        def there() -> bool:
            ended = self.process.poll()
            if (found := self.state) == state:
                return True
            if ended is not None and state != GONE:
                raise RuntimeError(
                    f"{self.name} ended with {ended} before its lease was {state}:\n{self.output}"
                )
            raise AssertionError(f"the lease of {self.name} is {found}, not {state}")

        eventually(there, within_s)

    def tell(self, text: str) -> None:
        """Write one line to its standard input."""
        assert self.process.stdin is not None
        self.process.stdin.write(f"{text}\n".encode())
        self.process.stdin.flush()

    def stop(self, number: signal.Signals = signal.SIGTERM) -> int:
        """Send it a signal, and return its exit code. Raises subprocess.TimeoutExpired."""
        self.process.send_signal(number)
        return self.process.wait(WITHIN_S)

    def wait(self, timeout_s: float = WITHIN_S) -> int:
        """Close its standard input, and return its exit code. Raises subprocess.TimeoutExpired."""
        self.process.communicate(timeout=timeout_s)
        return self.process.returncode

    def close(self) -> None:
        """End the process, and those that it started, if they run."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(self.pid, signal.SIGKILL)
        self.wait()
        self._printed.close()
