"""A program and the signals that it is sent."""

import os
import signal
from pathlib import Path

import pytest

from vram_arbiter.clients.foreign.program import ForeignProgram

pytestmark = pytest.mark.anyio


async def test_a_signal_to_a_program_that_has_just_ended_keeps_its_exit_code(
    tmp_path: Path,
) -> None:
    """Regression: asyncio's own `send_signal` took the exit code, and 255 was reported."""
    gate = tmp_path / "gate"
    os.mkfifo(gate)
    arguments = ["-c", 'read word < "$0"; exit 3', str(gate)]
    program = await ForeignProgram.start("/bin/sh", arguments, os.environ)
    gate.write_text("go\n")
    os.waitid(os.P_PID, program.pid, os.WEXITED | os.WNOWAIT)  # the loop has not seen it yet
    program.send_signal(signal.SIGTERM)
    assert await program.wait() == 3
    program.send_signal(signal.SIGTERM)  # nothing to signal
    assert not program.running


async def test_a_program_that_cannot_be_executed_is_an_error() -> None:
    with pytest.raises(PermissionError):
        await ForeignProgram.start(__file__, [], os.environ)
