"""README.md does what it says: its commands are typed in a fresh clone with an installed product,
its example runs as printed.

`readme.sh` alone types all of them; what installs, trains or takes minutes is left out here. Every
run of the tests types those of the base install; a robot's and the tutorial's are typed at night:
`test_page_blocks.py` parses them, and `tests/examples` and `tests/runner` run what they run.
"""

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.packaging.installed import install_into
from tests.support.paths import ROOT
from tests.support.process import ArbiterProcess
from vram_arbiter.clients.configs import configs_folder, shipped
from vram_arbiter.clients.sync import Client
from vram_arbiter.schemas.manifest import load_manifest

pytestmark = pytest.mark.e2e
PAGE = (ROOT / "README.md").read_text(encoding="utf-8")
LIMIT_S = 240.0
INSTALLS = "^(make|pip) "
OTHER_SIDECARS = "^vram-sidecar --name (detector|scene-vlm) "
LONG = "^vram-(reasoner|runner (benchmark|replay)) ?"


class Reader:
    """A folder with a clone, an environment with the product, and a home that is removed
    afterwards."""

    def __init__(self, folder: Path) -> None:
        for name in ("clone", "home", "run"):
            (folder / name).mkdir(mode=0o700)
        install_into(folder / "prefix")
        self._folder = folder
        git = ["git", "-C", str(ROOT)]
        listed = subprocess.run(
            [*git, "ls-files", "-z", "--cached", "--others", "--exclude-standard"],
            capture_output=True, text=True, check=True, timeout=60,
        )  # fmt: skip
        for name in filter(None, listed.stdout.split("\0")):
            if (ROOT / name).exists():  # else it is about to be removed
                place = folder / "clone" / name
                place.parent.mkdir(parents=True, exist_ok=True)
                shutil.copy2(ROOT / name, place, follow_symlinks=False)

    def types(self, *sections: str, skip: str, page: str = "README.md") -> str:
        """Everything that is printed. Fails the test at the first command that fails."""
        kept = {name: os.environ[name] for name in ("MUJOCO_GL", "LANG") if name in os.environ}
        done = subprocess.run(
            ["tests/packaging/readme.sh", *sections],
            cwd=self._folder / "clone", timeout=LIMIT_S, text=True,
            stdin=subprocess.DEVNULL, stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
            env={
                **kept, "SKIP": skip, "PAGE": page, "HOME": str(self._folder / "home"),
                "XDG_RUNTIME_DIR": str(self._folder / "run"),
                "PATH": f"{self._folder}/prefix/bin:/usr/local/bin:/usr/bin:/bin",
            },
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        return done.stdout


@pytest.fixture(scope="module")
def reader() -> Iterator[Reader]:
    if shutil.which("git") is None or not (ROOT / ".git").exists():
        pytest.skip("needs git and a checkout")
    folder = Path(tempfile.mkdtemp(prefix="vr"))  # short: sockets lie below it
    try:
        yield Reader(folder)
    finally:
        shutil.rmtree(folder)


def test_what_is_needed_is_said_before_the_first_command() -> None:
    before = PAGE.split("```sh\n")[0]
    assert "Python ≥ 3.12" in before
    assert "6 GB" in before


def test_the_commands_of_the_base_install_work(reader: Reader) -> None:
    printed = reader.types("For an operator", "For a program", skip=INSTALLS)
    assert re.search(r"^6 commands of README\.md work$", printed, re.MULTILINE)
    assert "Traceback" not in printed


@pytest.mark.nightly
def test_the_commands_of_the_tutorial_work(reader: Reader) -> None:
    printed = reader.types(skip=INSTALLS, page="docs/tutorial/first-leases.md")
    assert "detector is held again, with 1 weights" in printed
    assert printed.count("verdict=verified") >= 2, "each model left at least once"
    assert "Traceback" not in printed


def test_each_sidecar_of_the_page_has_a_shipped_model() -> None:
    names = re.findall(r"^vram-sidecar --name \S+ --rskill (\S+) &", PAGE, re.MULTILINE)
    assert len(names) == 3
    for name in names:
        load_manifest(shipped(Path(name), "rskills", configs_folder({})))


@pytest.mark.heavy
@pytest.mark.nightly
def test_the_commands_with_a_robot_work(reader: Reader) -> None:
    """One sidecar is started: each imports for 8 s of a core."""
    skip = f"{INSTALLS}|{LONG}|{OTHER_SIDECARS}|^vramctl "
    printed = reader.types("For an operator", "For a robot", skip=skip)
    assert "vram-sidecar --name grab" in printed
    assert "dry run: nothing was opened" in printed
    assert "Traceback" not in printed


def test_a_command_that_fails_fails_the_script(reader: Reader, tmp_path: Path) -> None:
    """The check can fail."""
    (tmp_path / "README.md").write_text("## A\n```sh\ntrue  # fine\nfalse\n```\n")
    done = subprocess.run(
        [str(ROOT / "tests/packaging/readme.sh")],
        cwd=tmp_path, env={**os.environ, "XDG_RUNTIME_DIR": str(tmp_path)}, capture_output=True,
        text=True, timeout=60,
    )  # fmt: skip
    assert (done.returncode, done.stderr) == (1, "readme.sh: exit code 1 of: false\n")


@pytest.mark.parametrize(
    ("page", "consumer", "printed"),
    [
        ("README.md", "detector", "detecting\n"),
        (
            "docs/how-to/write-a-consumer.md",
            "my-model",
            "first: ['on the GPU']\nsecond: ['on the GPU']\n",
        ),
    ],
)
def test_the_example_runs_as_printed(
    arbiter_daemon: ArbiterProcess, tmp_path: Path, page: str, consumer: str, printed: str
) -> None:
    """It ended in a traceback: its `unload` is a plain function, and only coroutine functions were
    taken."""
    text = (ROOT / page).read_text(encoding="utf-8")
    (example,) = re.findall(r"```python\n(.*?)```", text, re.DOTALL)
    path = tmp_path / "example.py"
    path.write_text(example)
    done = subprocess.run(
        [sys.executable, str(path)],
        env=arbiter_daemon.environ,
        capture_output=True,
        text=True,
        timeout=LIMIT_S,
    )
    assert (done.returncode, done.stdout, done.stderr) == (0, printed, "")
    with Client("t", endpoint=arbiter_daemon.endpoint) as client:
        kinds = [
            event["kind"] for event in client.history().events if event.get("consumer") == consumer
        ]
    assert {"granted", "ready", "use_began", "use_ended", "released"} <= set(kinds)
