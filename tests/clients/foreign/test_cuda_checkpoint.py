"""Suspending and resuming CUDA processes: the steps with a simulated driver, and what a machine
must have."""

import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from vram_arbiter.clients.foreign.cuda_checkpoint import CheckpointAction, CudaDriver, State
from vram_arbiter.schemas.errors import ActionFailed, CheckpointUnsupported

LIMIT_S = 30.0


class SimulatedDriver:
    """States of processes as the CUDA driver moves them; a call in the wrong state is refused.

    `failing`: a step and a pid that are refused, as (step, pid) → state afterwards.
    """

    def __init__(self, **states: State) -> None:
        self.states = {int(name[1:]): state for name, state in states.items()}
        self.failing: dict[tuple[str, int], State] = {}
        self.did: list[tuple[str, int]] = []

    def state(self, pid: int) -> State:
        return self.states.get(pid, State.NONE)

    def lock(self, pid: int, timeout_ms: int) -> None:
        assert 0 < timeout_ms <= LIMIT_S * 1000
        self._step("lock", pid, State.RUNNING, State.LOCKED)

    def checkpoint(self, pid: int) -> None:
        self._step("checkpoint", pid, State.LOCKED, State.CHECKPOINTED)

    def restore(self, pid: int) -> None:
        self._step("restore", pid, State.CHECKPOINTED, State.LOCKED)

    def unlock(self, pid: int) -> None:
        self._step("unlock", pid, State.LOCKED, State.RUNNING)

    def _step(self, what: str, pid: int, before: State, after: State) -> None:
        self.did.append((what, pid))
        if (what, pid) in self.failing:
            self.states[pid] = self.failing[what, pid]
            raise ActionFailed(f"{what} of pid {pid} failed")
        if self.states[pid] is not before:
            raise ActionFailed(f"{what} of pid {pid}: it is {self.states[pid].value}")
        self.states[pid] = after


class Api(SimpleNamespace):
    """Functions of `cuda.bindings.driver` over a SimulatedDriver, with the real enumerations."""

    def __init__(self, version: int, states: SimulatedDriver) -> None:
        real = pytest.importorskip("cuda.bindings.driver")
        done = real.CUresult.CUDA_SUCCESS
        super().__init__(
            CUresult=real.CUresult,
            CUprocessState=real.CUprocessState,
            CUcheckpointLockArgs=real.CUcheckpointLockArgs,
            cuDriverGetVersion=lambda: (done, version),
            cuInit=lambda flags: (done,),
            cuCheckpointProcessGetState=self._state,
        )
        self._states = states
        for step in ("Lock", "Checkpoint", "Restore", "Unlock"):
            setattr(self, f"cuCheckpointProcess{step}", lambda pid, args, s=step: self._do(s, pid))

    def _state(self, pid: int) -> tuple[Any, Any]:
        state = self._states.state(pid)
        if state is State.NONE:
            return self.CUresult.CUDA_ERROR_INVALID_VALUE, self.CUprocessState(0)
        names = {State.FAILED: "FAILED", State.RUNNING: "RUNNING", State.LOCKED: "LOCKED"}
        name = names.get(state, "CHECKPOINTED")
        return self.CUresult.CUDA_SUCCESS, getattr(self.CUprocessState, f"CU_PROCESS_STATE_{name}")

    def _do(self, step: str, pid: int) -> tuple[Any]:
        arguments = (pid, 1) if step == "Lock" else (pid,)
        try:
            getattr(self._states, step.lower())(*arguments)
        except ActionFailed:
            return (self.CUresult.CUDA_ERROR_NOT_PERMITTED,)
        return (self.CUresult.CUDA_SUCCESS,)


def over(states: SimulatedDriver, version: int = 12080) -> CudaDriver:
    return CudaDriver(Api(version, states))


def suspended(states: SimulatedDriver) -> CheckpointAction:
    return CheckpointAction(over(states), LIMIT_S)


def test_all_cuda_processes_are_suspended_and_resumed() -> None:
    """The shell that started them is none. All are locked before one is checkpointed, so that no
    process goes on with a peer that is away."""
    driver = SimulatedDriver(p2=State.RUNNING, p3=State.RUNNING)
    action = suspended(driver)
    action.free([1, 2, 3])
    assert driver.did == [("lock", 2), ("lock", 3), ("checkpoint", 2), ("checkpoint", 3)]
    driver.did.clear()
    action.restore([1, 2, 3])
    assert driver.did == [("restore", 2), ("unlock", 2), ("restore", 3), ("unlock", 3)]
    assert set(driver.states.values()) == {State.RUNNING}


@pytest.mark.parametrize("step", ["lock", "checkpoint"])
def test_a_process_that_cannot_be_suspended_leaves_none_suspended(step: str) -> None:
    driver = SimulatedDriver(p2=State.RUNNING, p3=State.RUNNING)
    driver.failing[step, 3] = State.RUNNING if step == "lock" else State.LOCKED
    with pytest.raises(
        ActionFailed, match=f"{step} of pid 3: CUDA_ERROR_NOT_PERMITTED; the program"
    ):
        suspended(driver).free([2, 3])
    assert driver.states == {2: State.RUNNING, 3: State.RUNNING}


def test_a_broken_process_is_named() -> None:
    """The driver may leave a process broken whose checkpoint fails, with unified memory say."""
    driver = SimulatedDriver(p2=State.RUNNING, p3=State.RUNNING)
    driver.failing["checkpoint", 2] = State.FAILED
    with pytest.raises(ActionFailed, match="the CUDA state of pid 2 is broken"):
        suspended(driver).free([2, 3])
    assert driver.states == {2: State.FAILED, 3: State.RUNNING}


def test_a_restore_that_fails_is_told_and_the_others_return() -> None:
    driver = SimulatedDriver(p2=State.RUNNING, p3=State.RUNNING)
    action = suspended(driver)
    action.free([2, 3])
    driver.failing["restore", 2] = State.CHECKPOINTED
    with pytest.raises(
        ActionFailed, match=r"restore of pid 2: CUDA_ERROR_NOT_PERMITTED \(the program"
    ):
        action.restore([2, 3])
    assert driver.states == {2: State.CHECKPOINTED, 3: State.RUNNING}


# -- requirements
def proc(folder: Path, scope: int, capabilities: int) -> Path:
    (folder / "sys/kernel/yama").mkdir(parents=True)
    (folder / "sys/kernel/yama/ptrace_scope").write_text(f"{scope}\n")
    (folder / "self").mkdir()
    (folder / "self/status").write_text(f"Name:\tx\nCapEff:\t{capabilities:016x}\n")
    return folder


@pytest.mark.parametrize(
    ("scope", "capabilities", "allowed"),
    [(0, 0, True), (1, 0, True), (2, 0, False), (2, 1 << 19, True), (3, 1 << 19, False)],
)
def test_privileges(scope: int, capabilities: int, allowed: bool, tmp_path: Path) -> None:
    driver, folder = over(SimulatedDriver()), proc(tmp_path, scope, capabilities)
    action = CheckpointAction(driver, LIMIT_S, "x86_64", folder)
    if allowed:
        action.check()
    else:
        with pytest.raises(CheckpointUnsupported, match=f"ptrace_scope is {scope}"):
            action.check()


def test_other_architectures_are_refused(tmp_path: Path) -> None:
    with pytest.raises(CheckpointUnsupported, match="needs x86_64, this machine is aarch64"):
        CheckpointAction(CudaDriver(), LIMIT_S, "aarch64", tmp_path).check()


def test_the_drivers_calls() -> None:
    """Arguments and answers as `cuda.bindings` has them."""
    states = SimulatedDriver(p2=State.RUNNING)
    driver, action = over(states), suspended(states)
    driver.check()
    assert driver.state(1) is State.NONE
    action.free([1, 2])
    assert states.states[2] is driver.state(2) is State.CHECKPOINTED
    action.restore([1, 2])
    assert states.states[2] is State.RUNNING
    states.failing["lock", 2] = State.RUNNING
    with pytest.raises(ActionFailed, match=r"lock of pid 2: CUDA_ERROR_NOT_PERMITTED.*SYS_PTRACE"):
        action.free([2])


def test_a_driver_that_is_too_old() -> None:
    with pytest.raises(CheckpointUnsupported, match=r"driver 570.*CUDA 12\.4"):
        over(SimulatedDriver(), 12040).check()


# -- a real driver
COUNTER = """
import os, sys, torch
kept = torch.arange(64 << 20, dtype=torch.int32, device="cuda")
for line in sys.stdin:
    kept += 1
    print(int(kept[0]), int(kept[-1]) - int(kept[0]) == kept.numel() - 1, flush=True)
"""
"""256 MiB on the GPU, changed with every line."""


@pytest.mark.gpu
@pytest.mark.heavy
def test_a_real_program_is_suspended_and_goes_on() -> None:
    """NVML shows no byte of it meanwhile, and its tensors are what they were."""
    action = CheckpointAction(CudaDriver(), 60.0)
    try:
        action.check()
    except CheckpointUnsupported as error:
        pytest.skip(str(error))
    pynvml = pytest.importorskip("pynvml")
    pynvml.nvmlInit()

    def listed() -> bool:
        gpus = map(pynvml.nvmlDeviceGetHandleByIndex, range(pynvml.nvmlDeviceGetCount()))
        found = [one for gpu in gpus for one in pynvml.nvmlDeviceGetComputeRunningProcesses(gpu)]
        return program.pid in [one.pid for one in found]

    with subprocess.Popen(
        [sys.executable, "-c", COUNTER], stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True
    ) as program:
        assert program.stdout is not None

        def count() -> None:
            program.stdin.write("\n")
            program.stdin.flush()

        count()
        assert program.stdout.readline() == "1 True\n"
        assert listed()
        action.free([program.pid])
        assert not listed()
        count()  # waits in its CUDA call
        action.restore([program.pid])
        assert program.stdout.readline() == "2 True\n"
        program.stdin.close()
        assert program.wait(60) == 0
