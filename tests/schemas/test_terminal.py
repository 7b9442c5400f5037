"""Programs whose reader leaves (`| head`), or who are told Ctrl-C, end without a traceback."""

import os
import signal
import subprocess
import sys
from pathlib import Path

import pytest

from schemas import terminal
from schemas.units import parse_bytes

ROOT = Path(__file__).parents[2]
MANIFEST = ROOT / "tests/schemas/manifests"
PATIENCE_S = 60


@pytest.mark.parametrize(
    "arguments",
    [
        ["-m", "schemas", "check", str(MANIFEST)],
        ["-m", "arbiter.replay", "simulate", str(ROOT / "configs/scenarios/find-navigate-grab.yaml")],
        ["-m", "arbiter.replay", "simulate", "--json", str(ROOT / "configs/scenarios/two-thrashing.yaml")],
        ["-m", "clients", "simulate", "find-navigate-grab"],
    ],
)
def test_a_reader_that_left_is_no_defect(arguments: list[str]) -> None:
    reading, writing = os.pipe()
    os.close(reading)  # nobody will ever read
    try:
        done = subprocess.run(
            [sys.executable, *arguments],
            cwd=ROOT,
            stdout=writing,
            stderr=subprocess.PIPE,
            text=True,
            timeout=PATIENCE_S,
        )
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (terminal.READER_LEFT, "")


def test_ctrl_c_is_no_defect() -> None:
    """The first line of a simulation is printed when the whole is known: it is told before, while it works."""
    program = (
        "import signal, sys\n"
        "from schemas import terminal\n"
        "@terminal.program\n"
        "def main():\n"
        "    print('there', flush=True)\n"
        "    signal.pause()\n"
        "    return 0\n"
        "sys.exit(main())\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program], cwd=ROOT, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )
    try:
        assert process.stdout is not None
        assert process.stdout.readline() == "there\n"
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, told) == (terminal.INTERRUPTED, "")


def test_a_pipe_of_the_programs_own_that_breaks_is_its_error() -> None:
    @terminal.program
    def main() -> int:
        raise BrokenPipeError("another pipe")

    with pytest.raises(BrokenPipeError, match="another pipe"):
        main()


def test_the_exit_code_and_the_arguments_pass() -> None:
    assert terminal.program(parse_bytes)("8KiB") == 8192
