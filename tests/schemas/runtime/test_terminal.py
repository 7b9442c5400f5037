"""Programs whose reader leaves, whose output device is full (`| head`), or who are told Ctrl-C, end
without a traceback."""

import errno
import os
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from tests.support.paths import ROOT
from tests.support.waiting import PATIENCE_S
from vram_arbiter.schemas.runtime import terminal
from vram_arbiter.schemas.units import parse_bytes

MANIFEST = ROOT / "tests/schemas/manifest/samples"
GRAB = ROOT / "configs/rskills/so101-grab/rskill.yaml"
BUFFERED = {key: value for key, value in os.environ.items() if key != "PYTHONUNBUFFERED"}
"""argparse itself swallows the error of an unbuffered device."""


def ran(*arguments: str, **options: Any) -> "subprocess.CompletedProcess[str]":
    """Run an interpreter to its end; `options` of `subprocess.run`."""
    given = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE} | options
    return subprocess.run(
        [sys.executable, *arguments], cwd=ROOT, text=True, timeout=PATIENCE_S, **given
    )


def test_a_reader_that_left_is_no_defect() -> None:
    """Regression: A report cut off by `| head` ended with a traceback."""
    reading, writing = os.pipe()
    os.close(reading)  # nobody will ever read
    try:
        done = ran("-m", "vram_arbiter.schemas", "check", str(MANIFEST), stdout=writing)
    finally:
        os.close(writing)
    assert (done.returncode, done.stderr) == (terminal.READER_LEFT, "")


def test_ctrl_c_is_no_defect() -> None:
    """The first line of a simulation is printed when the whole is known: it is told before, while
    it works."""
    program = (
        "import signal, sys\n"
        "from vram_arbiter.schemas.runtime import terminal\n"
        "@terminal.program\n"
        "def main():\n"
        "    print('there', flush=True)\n"
        "    signal.pause()\n"
        "    return 0\n"
        "sys.exit(main())\n"
    )
    process = subprocess.Popen(
        [sys.executable, "-c", program],
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )
    try:
        assert process.stdout.readline() == "there\n"
        process.send_signal(signal.SIGINT)
        _, told = process.communicate(timeout=PATIENCE_S)
    finally:
        process.kill()
        process.wait()
    assert (process.returncode, told) == (terminal.INTERRUPTED, "")


@pytest.mark.parametrize(
    "error", [BrokenPipeError("another pipe"), OSError(errno.ECHILD, "a defect")]
)
def test_an_error_of_the_programs_own_keeps_its_traceback(error: OSError) -> None:
    @terminal.program
    def main() -> int:
        raise error

    with pytest.raises(type(error)) as raised:
        main()
    assert raised.value is error


def test_the_exit_code_and_the_arguments_pass() -> None:
    assert terminal.program(parse_bytes)("8KiB") == 8192


@pytest.mark.parametrize(
    "arguments",
    [
        ["vram_arbiter.schemas", "check", str(MANIFEST)],
        ["vram_arbiter.arbiter", "--help"],
        ["vram_arbiter.clients", "status", "--json"],
    ],
)
def test_a_full_output_device_is_one_line(arguments: list[str], tmp_path: Path) -> None:
    """`vramctl doctor > /dev/full` ended with a traceback."""
    with open("/dev/full", "wb") as full:
        environ = {**BUFFERED, "VRAM_ARBITER_RUNTIME": str(tmp_path)}
        done = ran("-m", *arguments, env=environ, stdout=full)
    (line,) = done.stderr.splitlines()
    assert line.endswith(": the output cannot be written: No space left on device")
    assert done.returncode == terminal.NO_ROOM


def test_a_full_disk_behind_a_file_is_named(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    @terminal.program
    def main() -> int:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC), "out/summary.json")

    monkeypatch.setattr(terminal, "silence", lambda: None)
    assert main() == terminal.NO_ROOM
    said = capsys.readouterr().err
    assert "out/summary.json cannot be written: No space left on device" in said


@pytest.mark.parametrize(
    ("arguments", "extra"),
    [
        ("clients demo", "all"),
        (f"sidecars --name x --rskill {GRAB} --device none --no-arbiter", "sidecars"),
        ("runner sim --no-arbiter", "runner"),
    ],
)
def test_a_missing_extra_is_one_line(arguments: str, extra: str, tmp_path: Path) -> None:
    """In the base install `vramctl demo` and `vram-sidecar` ended with tracebacks, the second at
    its first request."""
    program = (
        "import runpy, sys\n"
        "for name in ('torch', 'lerobot', 'mujoco', 'cv2', 'numpy'): sys.modules[name] = "
        "None\n"  # as if not installed
        "sys.argv = sys.argv[1:]\n"
        "runpy.run_module(sys.argv[0], run_name='__main__', alter_sys=True)\n"
    )
    environ = {**os.environ, "VRAM_ARBITER_RUNTIME": str(tmp_path)}
    done = ran("-c", program, *f"vram_arbiter.{arguments}".split(), env=environ)
    (line,) = done.stderr.splitlines()
    assert f"pip install 'vram-arbiter[{extra}]'" in line
    assert done.returncode in (1, 2)
    assert list(tmp_path.iterdir()) == [], "nothing was begun"
