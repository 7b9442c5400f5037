"""What /proc says of processes."""

import os
import subprocess
import sys

from vram_arbiter.schemas.runtime import procfs


def test_a_name_with_spaces_and_parentheses_is_read() -> None:
    tail = " ".join(["S", "3", *["0"] * 17, "4711"])
    assert procfs.parse_stat(f"7 (a) Z (b)) {tail}".encode()) == procfs.Stat(
        "a) Z (b)", True, 3, 4711
    )


def test_a_zombie_is_dead_and_keeps_its_start_time() -> None:
    """Its memory is gone, but its pid and start time still name it until it is reaped."""
    child = subprocess.Popen([sys.executable, "-c", ""])
    try:
        os.waitid(os.P_PID, child.pid, os.WEXITED | os.WNOWAIT)
        stat = procfs.read_stat(child.pid)
        assert (stat.alive, stat.parent_pid) == (False, os.getpid())
        assert procfs.start_ticks(child.pid) == stat.start_ticks > 0
    finally:
        child.wait()
    assert procfs.read_stat(child.pid) is None
    assert procfs.start_ticks(child.pid) is None
