"""`.ci/jetson` on a board that it has never seen: what it installs, in which order, and what it
refuses. The board's tools are stand-ins; the shell is real."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from tests.support.paths import ROOT

SCRIPT = ROOT / ".ci/jetson"
SHELLCHECK = Path(sys.executable).with_name("shellcheck")
JETPACK_7 = "# R38 (release), REVISION: 2.0, GCID: 41844464, BOARD: generic, EABI: aarch64\n"
TOOLS = ("apt-get", "apt-cache", "dpkg", "git", "cmake", "uv", "gst-inspect-1.0", "id")
STAND_IN = """#!/bin/sh
echo "${0##*/} $*" >>"$LOG"
case "${0##*/} $*" in
id*) echo 0 ;;
apt-cache*) echo "$2 | 1.0 | a source" ;;
dpkg*nvidia-l4t-*) exit 1 ;;
"uv venv"*)
    mkdir -p "$4/bin" && printf '#!/bin/sh\\n' >"$4/bin/python" && chmod +x "$4/bin/python" ;;
"gst-inspect-1.0 --exists $LACKS") exit 1 ;;
esac
"""


class Board:
    """A prefix and stand-ins for the tools of a board, which say what they were asked for."""

    def __init__(self, folder: Path) -> None:
        self.prefix, self.log, self.tools = folder / "prefix", folder / "log", folder / "bin"
        self.release = folder / "nv_tegra_release"
        self.release.write_text(JETPACK_7)
        self.tools.mkdir()
        self.log.touch()
        for tool in TOOLS:
            (self.tools / tool).write_text(STAND_IN)
            (self.tools / tool).chmod(0o755)

    def set_up(self, *arguments: str, lacks: str = "-") -> subprocess.CompletedProcess[str]:
        environ = os.environ | {
            "PATH": f"{self.tools}:{os.environ['PATH']}",
            "LOG": str(self.log),
            "LACKS": lacks,
            "NV_TEGRA_RELEASE": str(self.release),
        }
        command = [str(SCRIPT), *arguments, str(self.prefix)]
        return subprocess.run(command, env=environ, capture_output=True, text=True, timeout=60)

    def did(self) -> list[str]:
        """What the tools were asked to do, without questions."""
        asked = self.log.read_text().splitlines()
        return [line for line in asked if not line.startswith(("id", "dpkg", "apt-cache"))]


@pytest.fixture
def board(tmp_path: Path) -> Board:
    return Board(tmp_path)


def test_everything_is_installed_in_its_order(board: Board) -> None:
    done = board.set_up()
    assert done.returncode == 0, done.stderr
    steps = board.did()
    assert steps[:2] == [
        "apt-get update -qq",
        "apt-get install -y -qq --no-install-recommends nvidia-l4t-gstreamer nvidia-l4t-camera",
    ]
    assert steps[2] == f"uv venv --python 3.12 {board.prefix}"
    assert steps[3].startswith("git clone --quiet --depth 1 --branch 11.")
    assert [step.split()[0] for step in steps[4:6]] == ["cmake", "cmake"]
    dds, torch, rest = (step for step in steps[6:] if step.startswith("uv pip install"))
    assert "--no-binary cyclonedds cyclonedds==11." in dds
    assert "--index-url https://pypi.jetson-ai-lab.io/sbsa/cu130 torch>=2.7" in torch
    assert rest.endswith(".[sidecars,runner,reasoner,ros2,gstreamer,observer]")
    assert f"sudo {board.prefix}/bin/vramctl install" in done.stderr


def test_a_repeat_builds_nothing_again(board: Board) -> None:
    assert board.set_up().returncode == 0
    (library,) = (word for word in board.log.read_text().split() if "INSTALL_PREFIX=" in word)
    built = Path(library.partition("=")[2]) / "lib/libddsc.so"
    built.parent.mkdir(parents=True)
    built.touch()
    board.log.write_text("")
    assert board.set_up().returncode == 0
    assert not [step for step in board.did() if step.startswith(("git", "cmake", "uv venv"))]


def test_a_dry_run_does_nothing(board: Board) -> None:
    done = board.set_up("--dry-run")
    assert done.returncode == 0, done.stderr
    assert board.did() == []
    assert f"+ uv venv --python 3.12 {board.prefix}" in done.stdout


@pytest.mark.parametrize(
    ("release", "says"),
    [
        (None, "this is no Jetson"),
        ("# R36 (release), REVISION: 4.3, GCID: 1\n", "built for Python 3.10, this needs 3.12"),
        ("# R39 (release), REVISION: 1.0\n", "L4T R39 is not known here"),
        ("garbage\n", "L4T R? is not known here"),
    ],
)
def test_another_machine_is_refused(board: Board, release: str | None, says: str) -> None:
    board.release.unlink() if release is None else board.release.write_text(release)
    refused = board.set_up()
    assert refused.returncode == 1
    assert says in refused.stderr
    assert board.did() == []


def test_a_board_without_its_elements_is_not_done(board: Board) -> None:
    refused = board.set_up(lacks="nvv4l2decoder")
    assert refused.returncode == 1
    assert "GStreamer has no nvv4l2decoder" in refused.stderr
    assert "done" not in refused.stderr


def test_packages_that_no_source_has_are_named(board: Board) -> None:
    (board.tools / "apt-cache").write_text("#!/bin/sh\n")
    refused = board.set_up()
    assert refused.returncode == 1
    assert "no package nvidia-l4t-gstreamer" in refused.stderr
    assert "nvidia*" in refused.stderr, "where NVIDIA's source would be"


def test_the_shell_scripts_are_clean() -> None:
    scripts = [*ROOT.glob(".ci/*"), *ROOT.glob("configs/**/*.sh"), *ROOT.glob("tests/**/*.sh")]
    assert SCRIPT in scripts
    found = subprocess.run([SHELLCHECK, *scripts], capture_output=True, text=True)
    assert found.returncode == 0, found.stdout
