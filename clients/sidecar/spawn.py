"""Start a sidecar as a child process, watch it through its pidfd, and end it: only ever the child
that we started.

It knows no sockets: whether the child *serves* is for `base` to find out by `ping`.
"""

import asyncio
import os
import signal
import subprocess
import tempfile
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

from vram_arbiter.clients._protocol import traces
from vram_arbiter.schemas.errors import SidecarUnavailable

BOOT_TIMEOUT_S = 120.0  # importing torch and lerobot takes ~8 s here, more on a busy machine
TERM_TIMEOUT_S = 10.0
KILL_TIMEOUT_S = 5.0
LOG_TAIL_BYTES = 4000


@dataclass(frozen=True, slots=True)
class SpawnSpec:
    """How to start a sidecar, e.g. `[sys.executable, "-m", "vram_arbiter.sidecars", "--name",
    "grab", …]`.

    `env` is added to this process' environment. `log` receives its output (None: a temporary file,
    for the error's details).
    """

    argv: Sequence[str]
    env: Mapping[str, str] | None = None
    log: Path | None = None
    boot_timeout_s: float = BOOT_TIMEOUT_S


class Child:
    """One started process. `exited` is set when the kernel says so; needs a running loop."""

    def __init__(self, spec: SpawnSpec) -> None:
        self.exited = asyncio.Event()
        self._spec = spec
        self._temporary = spec.log is None
        if spec.log is None:
            handle, name = tempfile.mkstemp(prefix="sidecar-", suffix=".log")
            self._log = Path(name)
        else:
            spec.log.parent.mkdir(parents=True, exist_ok=True)
            self._log = spec.log
            handle = os.open(spec.log, os.O_WRONLY | os.O_CREAT | os.O_APPEND | os.O_CLOEXEC, 0o640)
        try:
            self._process = subprocess.Popen(
                list(spec.argv),
                env={**os.environ, **traces.environ(), **(spec.env or {})},
                stdin=subprocess.DEVNULL,
                stdout=handle,
                stderr=handle,
                start_new_session=True,  # Ctrl-C is for us; we end the child in order
            )
        except OSError as error:
            if self._temporary:
                self._log.unlink()
            raise SidecarUnavailable(
                f"cannot start {spec.argv[0]}: {error.strerror}",
                hint="check the command of the sidecar",
            ) from error
        finally:
            os.close(handle)
        self._pidfd = os.pidfd_open(self._process.pid)
        self._loop = asyncio.get_running_loop()
        self._loop.add_reader(self._pidfd, self._gone)

    @property
    def pid(self) -> int:
        return self._process.pid

    @property
    def alive(self) -> bool:
        return not self.exited.is_set()

    def _gone(self) -> None:
        self._loop.remove_reader(self._pidfd)
        self._process.wait()  # reaps: it is dead already
        os.close(self._pidfd)
        self.exited.set()

    def failure(self) -> SidecarUnavailable:
        """Why an exited child is of no use, with its exit code and the end of its log."""
        code = self._process.returncode
        if code == -signal.SIGKILL:
            what, hint = (
                "was killed (SIGKILL)",
                "unless a person did it, the machine's memory was full: see dmesg",
            )
        elif code is not None and code < 0:
            what, hint = f"died of {signal.Signals(-code).name}", "see its log"
        else:
            what, hint = f"ended with exit code {code}", "see its log"
        tail = self.log_tail()
        last = tail.strip().splitlines()[-1] if tail.strip() else "its log is empty"
        return SidecarUnavailable(
            f"the sidecar {what}: {last}",
            hint=hint,
            details={
                "exit_code": code,
                "log": tail,
                "log_path": str(self._log),
                "argv": list(self._spec.argv),
            },
        )

    def log_tail(self) -> str:
        try:
            with self._log.open("rb") as file:
                file.seek(max(0, self._log.stat().st_size - LOG_TAIL_BYTES))
                return file.read().decode(errors="replace")
        except OSError as error:
            return f"(its log cannot be read: {error.strerror})"

    async def wait(self, timeout_s: float) -> bool:
        """Whether it has ended within that time."""
        if self.exited.is_set():
            return True
        try:
            await asyncio.wait_for(self.exited.wait(), timeout_s)
        except TimeoutError:
            return False
        return True

    async def end(self, polite_s: float) -> None:
        """Wait `polite_s` for it to end by itself (after a `shutdown` op), then SIGTERM, then
        SIGKILL. Through the pidfd: the pid may belong to another process by then."""
        for timeout_s, number in (
            (polite_s, signal.SIGTERM),
            (TERM_TIMEOUT_S, signal.SIGKILL),
            (KILL_TIMEOUT_S, None),
        ):
            if await self.wait(timeout_s):
                break
            if number is not None:
                signal.pidfd_send_signal(self._pidfd, number)
        if self._temporary:
            self._log.unlink(missing_ok=True)
