"""Long lines of `vramctl` on a terminal: folded between words. Programs get them whole."""

import os
import pty
import subprocess
import sys
import termios

import pytest

from tests.support.process import ArbiterProcess, vramctl
from vram_arbiter.clients.cli import terminal
from vram_arbiter.clients.cli.doctor import lines_of
from vram_arbiter.clients.cli.doctor.findings import Report, error

FIX = "sudo systemctl start vram-arbiter # " + "a long command " * 8


def test_a_line_is_folded_below_its_own_text() -> None:
    line = "  next      waits for detector to finish 1 use"
    assert terminal.folded(line, 12, None) == [line]
    assert terminal.folded(line, 12, 80) == [line]
    assert terminal.folded(line, 12, 30) == [
        "  next      waits for detector",
        "            to finish 1 use",
    ]
    long = "ipc://" + "x" * 60
    assert terminal.folded(f"at {long}", 4, 40) == ["at", f"    {long}"], "a name stays whole"


def test_the_doctor_folds_findings_and_no_command() -> None:
    """A command is to be copied: a line break in it would be typed."""
    report = Report("ipc:///x", (error("socket.dead", "no arbiter " * 12, FIX),))
    first, *more = lines_of(report, width=80)[1:-1]
    assert "no arbiter" in first
    assert len(more) > 1
    assert all(len(line) <= 80 for line in more[:-1])
    assert all(line.startswith(" " * 32) for line in more)
    assert more[-1].endswith(f"→ {FIX.rstrip()}") or more[-1].endswith(f"→ {FIX}")


@pytest.mark.e2e
def test_why_fits_the_terminal(arbiter_daemon: ArbiterProcess) -> None:
    """On 60 columns the terminal broke its lines within words."""
    whole = vramctl("why", "nothing", environ=arbiter_daemon.environ).stdout
    assert len(whole.splitlines()) == 1
    master, screen = pty.openpty()
    termios.tcsetwinsize(screen, (24, 60))
    done = subprocess.run(
        [sys.executable, "-m", "vram_arbiter.clients", "why", "nothing"],
        env={name: text for name, text in arbiter_daemon.environ.items() if name != "COLUMNS"},
        stdin=screen, stdout=screen, stderr=subprocess.DEVNULL, timeout=60,
    )  # fmt: skip
    os.close(screen)
    shown = os.read(master, 65_536).decode()
    os.close(master)
    assert done.returncode == 1
    assert len(shown.splitlines()) > 1
    assert all(len(line) <= 60 for line in shown.splitlines())
    assert shown.split() == whole.split()
