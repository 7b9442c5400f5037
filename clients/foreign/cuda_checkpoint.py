"""Suspending and resuming CUDA programs without their help, through the driver.

The driver blocks a process's CUDA calls (lock), copies its device memory to host RAM and releases
the GPU with its context (checkpoint); `restore` and `unlock` undo that
(https://docs.nvidia.com/cuda/cuda-driver-api/group__CUDA__CHECKPOINT.html). Its limits are NVIDIA's
(https://github.com/NVIDIA/cuda-checkpoint): x86_64, no unified (UVM) and no IPC memory.

`cuda.bindings` is imported when the action is used, and makes no context here.
"""

import platform
from collections.abc import Sequence
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any, ClassVar, Final

from vram_arbiter.clients.foreign.actions import Deadline
from vram_arbiter.schemas.errors import ActionFailed, CheckpointUnsupported
from vram_arbiter.schemas.runtime import procfs

MACHINE: Final = "x86_64"
CUDA_VERSION: Final = 12080
"""Of driver 570, the first with these calls."""
CAP_SYS_PTRACE: Final = 19
CAP_NEEDED, NO_ATTACH = 2, 3
"""Values of Yama's `ptrace_scope`: with CAP_SYS_PTRACE only, and no attach."""


class State(Enum):
    """CUDA state of a process."""

    NONE = "none"  # it has not initialized CUDA
    RUNNING = "running"
    LOCKED = "locked"
    CHECKPOINTED = "checkpointed"
    FAILED = "failed"


class CudaDriver:
    """The calls of the CUDA driver that are needed, through `cuda.bindings.driver` or an object
    with its functions."""

    def __init__(self, api: Any = None) -> None:
        self._given = api

    def check(self) -> None:
        """Raises CheckpointUnsupported where the driver lacks these calls."""
        api = self._api()
        try:
            result, version = api.cuDriverGetVersion()
        except RuntimeError as error:  # cuda.pathfinder.DynamicLibNotFoundError
            raise CheckpointUnsupported(
                "cuda-checkpoint needs an NVIDIA driver, none was found", hint="install it"
            ) from error
        if result != api.CUresult.CUDA_SUCCESS or version < CUDA_VERSION:
            major, minor = version // 1000, version % 1000 // 10
            raise CheckpointUnsupported(
                f"cuda-checkpoint needs driver 570 (CUDA 12.8), this one is for CUDA "
                f"{major}.{minor}",
                hint="install a newer driver",
            )
        (result,) = api.cuInit(0)
        if result != api.CUresult.CUDA_SUCCESS:
            raise CheckpointUnsupported(
                f"cuda-checkpoint: the driver does not start: {result.name}",
                hint="what does nvidia-smi say?",
            )

    def state(self, pid: int) -> State:
        api = self._api()
        result, state = api.cuCheckpointProcessGetState(pid)
        if result != api.CUresult.CUDA_SUCCESS:
            return State.NONE  # the driver knows no such process
        known = {
            api.CUprocessState.CU_PROCESS_STATE_RUNNING: State.RUNNING,
            api.CUprocessState.CU_PROCESS_STATE_LOCKED: State.LOCKED,
            api.CUprocessState.CU_PROCESS_STATE_CHECKPOINTED: State.CHECKPOINTED,
        }
        return known.get(state, State.FAILED)

    def lock(self, pid: int, timeout_ms: int) -> None:
        arguments = self._api().CUcheckpointLockArgs()
        arguments.timeoutMs = timeout_ms
        self.step("Lock", pid, arguments)

    def step(self, what: str, pid: int, arguments: object = None) -> None:
        """Lock, Checkpoint, Restore or Unlock a process. Raises ActionFailed."""
        api = self._api()
        (result,) = getattr(api, f"cuCheckpointProcess{what}")(pid, arguments)
        if result == api.CUresult.CUDA_SUCCESS:
            return
        hints = {
            api.CUresult.CUDA_ERROR_NOT_PERMITTED: "run vramctl as the program's user with "
            "CAP_SYS_PTRACE, and enable persistence mode (nvidia-smi -pm 1)",
            api.CUresult.CUDA_ERROR_NOT_READY: "its GPU work did not end in time: allow more by "
            "--timeout",
            api.CUresult.CUDA_ERROR_NOT_SUPPORTED: "unified and IPC memory cannot be suspended",
        }
        raise ActionFailed(
            f"cuda-checkpoint: {what.lower()} of pid {pid}: {result.name}",
            hint=hints.get(result, ""),
            details={"result": result.name, "pid": pid},
        )

    def _api(self) -> Any:
        if self._given is None:
            try:
                from cuda.bindings import driver
            except ImportError as error:
                raise CheckpointUnsupported(
                    "cuda-checkpoint needs the package cuda-bindings",
                    hint="pip install 'vram-arbiter[checkpoint]'",
                ) from error
            self._given = driver
        return self._given


@dataclass(slots=True)
class CheckpointAction:
    """Suspend all CUDA processes of a program, or none of them."""

    driver: CudaDriver
    timeout_s: float
    machine: str = platform.machine()
    proc: Path = procfs.PROC
    name: ClassVar = "cuda-checkpoint"
    keeps_context: ClassVar = False
    parks: ClassVar = True
    suspends: ClassVar = True

    def check(self) -> None:
        if self.machine != MACHINE:
            raise CheckpointUnsupported(
                f"cuda-checkpoint needs {MACHINE}, this machine is {self.machine}",
                hint="choose another --on-evict action, such as stop",
            )
        _check_privileges(self.proc)
        self.driver.check()

    def busy(self) -> int | None:
        return None  # `lock` waits for the work that was submitted

    def free(self, pids: Sequence[int]) -> None:
        """Lock all processes, then checkpoint them. What was done is undone where one fails."""
        deadline = Deadline(self.timeout_s)
        ours = [pid for pid in pids if self.driver.state(pid) is State.RUNNING]
        done: list[int] = []
        try:
            for pid in ours:
                left_s = deadline.left_s(f"cuda-checkpoint: lock of pid {pid}")
                self.driver.lock(pid, max(1, int(left_s * 1000)))
                done.append(pid)
            for pid in ours:
                self.driver.step("Checkpoint", pid)
        except ActionFailed as error:
            broken = self._resume(done)
            raise ActionFailed(
                error.message + (f"; {broken}" if broken else "; the program continues"),
                hint=error.hint,
                details=error.details,
            ) from error

    def restore(self, pids: Sequence[int]) -> None:
        if broken := self._resume(pids):
            raise ActionFailed(broken, hint="the program stays suspended: end it, start it again")

    def _resume(self, pids: Sequence[int]) -> str:
        """Restore and unlock whatever is suspended. Return what went wrong."""
        problems: list[str] = []
        for pid in pids:
            try:
                state = self.driver.state(pid)
                if state is State.CHECKPOINTED:
                    self.driver.step("Restore", pid)
                    state = State.LOCKED
                if state is State.LOCKED:
                    self.driver.step("Unlock", pid)
                elif state is State.FAILED:
                    problems.append(f"the CUDA state of pid {pid} is broken")
            except ActionFailed as error:
                problems.append(error.message)
        return "; ".join(problems)


def _check_privileges(proc: Path) -> None:
    """Raises CheckpointUnsupported where Yama forbids to control an own child."""
    try:
        scope = int((proc / "sys/kernel/yama/ptrace_scope").read_text())
    except FileNotFoundError:
        return  # without Yama the same user is enough
    capable = False
    for line in (proc / "self/status").read_text().splitlines():
        if line.startswith("CapEff:"):
            capable = bool(int(line.split()[1], 16) >> CAP_SYS_PTRACE & 1)
    if scope >= NO_ATTACH or (scope == CAP_NEEDED and not capable):
        raise CheckpointUnsupported(
            f"cuda-checkpoint may not control processes: kernel.yama.ptrace_scope is {scope}",
            hint="run vramctl with CAP_SYS_PTRACE"
            if scope < NO_ATTACH
            else "no process may attach until the next boot",
        )
