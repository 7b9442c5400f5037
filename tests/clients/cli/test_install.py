"""`vramctl install` and `uninstall` below a folder: the plan, what is kept, what is refused.

On a machine with a real systemd they run in tests/packaging/test_units_start.py.
"""

import io
import json
import os
import re
import shutil
import stat
import subprocess
import sys
import sysconfig
from collections.abc import Sequence
from pathlib import Path

import pytest

from vram_arbiter.clients.cli import install
from vram_arbiter.clients.cli.installation import completion as completing
from vram_arbiter.clients.cli.installation import environment
from vram_arbiter.clients.cli.main import COMMANDS, command_parser, run_main
from vram_arbiter.schemas.errors import ConfigError

UNIT = "etc/systemd/system/vram-arbiter.service"
SIDECAR = "etc/systemd/system/vram-sidecar@.service"
RECORD = "etc/vram-arbiter/installed.json"
SHORT = {Path("bash-completion/completions/vramctl"): "complete vramctl\n"}


@pytest.fixture(scope="module")
def scripts() -> dict[Path, str]:
    return completing.completions()


@pytest.fixture
def root(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A folder for another machine; its completion is short, because making it takes a second."""
    monkeypatch.setattr("vram_arbiter.clients.cli.installation.contents.completions", lambda: SHORT)
    return tmp_path / "root"


def vramctl(root: Path, *arguments: str) -> int:
    return run_main([*arguments, "--root", str(root)])


def tree(root: Path) -> dict[str, tuple[int, bytes]]:
    """Path → mode and content (a link's target) of everything that is not a folder."""
    found = {}
    for path in root.rglob("*"):
        if path.is_symlink():
            found[str(path.relative_to(root))] = (0, os.readlink(path).encode())
        elif path.is_file():
            mode = stat.S_IMODE(path.stat().st_mode)
            found[str(path.relative_to(root))] = (mode, path.read_bytes())
    return found


def test_a_plan_is_shown_then_performed_once(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    plan = ["install", "--prefix", "/opt/other"]
    assert vramctl(root, *plan, "--dry-run") == 0
    shown = capsys.readouterr().out
    assert not root.exists(), "a dry run writes nothing"

    assert vramctl(root, *plan, "--yes") == 0
    assert capsys.readouterr().out == shown
    files = tree(root)
    assert {f"new     /{path}" for path in files if path.startswith("etc/systemd")} <= {
        line.strip() for line in shown.splitlines()
    }
    for path, (mode, content) in files.items():
        if path.startswith("etc/"):
            assert mode == 0o644, path
        if path.startswith("etc/systemd") and path.endswith(".service"):
            assert b"ExecStart=/opt/other/bin/vram" in content
            assert b"/opt/vram-arbiter" not in content
    assert files["usr/local/bin/vramctl"] == (0, b"/opt/other/bin/vramctl")
    assert f"{UNIT}.d/tegra.conf" not in files, "for a Jetson only"

    written = os.stat(root / UNIT).st_ino
    assert vramctl(root, *plan) == 0, "nothing to ask"
    said = capsys.readouterr().out
    assert "nothing to change" in said
    assert " new " not in said
    assert (tree(root), os.stat(root / UNIT).st_ino) == (files, written)


@pytest.mark.parametrize("name", ["arbiter", "observer"])
def test_an_installed_example_names_a_schema_that_is_there(root: Path, name: str) -> None:
    """Regression: it named the clone's by a relative path, and editors found none."""
    assert vramctl(root, "install", "--prefix", "/opt/other", "--yes") == 0
    text = (root / f"etc/vram-arbiter/{name}.yaml.example").read_text()
    first = re.match(r"# yaml-language-server: \$schema=(/\S+)\n", text)
    assert first
    assert json.loads(Path(first[1]).read_text())["$schema"].startswith("https://json-schema.org/")


@pytest.mark.parametrize(("answer", "code"), [("", 1), ("yesterday\n", 1), ("y\n", 0)])
def test_the_plan_needs_a_yes(
    root: Path, monkeypatch: pytest.MonkeyPatch, answer: str, code: int
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(answer))
    assert vramctl(root, "install", "--prefix", "/opt/one") == code
    assert (root / UNIT).exists() == (code == 0)


def test_a_changed_file_is_kept(root: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """The next version is stood in for by another prefix, which changes every unit."""
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 0
    (root / SIDECAR).write_text("# the operator's\n")
    assert vramctl(root, "install", "--prefix", "/opt/two", "--yes") == 0
    said = capsys.readouterr().out
    assert f"keep    /{SIDECAR}: changed by hand; remove it to get this version" in said
    assert "ExecStart=/opt/two/bin/vram-arbiter --group" in (root / UNIT).read_text()
    assert (root / SIDECAR).read_text() == "# the operator's\n"
    (root / SIDECAR).unlink()
    assert vramctl(root, "install", "--prefix", "/opt/two", "--yes") == 0
    assert "/opt/two/bin/vram-sidecar" in (root / SIDECAR).read_text()


def test_links_below_the_folder_do_not_lead_out_of_it(
    root: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Regression: an absolute link of an image was followed by this machine's kernel, and units
    were written into the machine that builds the image."""
    outside = tmp_path / "outside"
    for folder in (outside, root / "etc", root / "usr", root / "data"):
        folder.mkdir(parents=True)
    (root / "usr/local").symlink_to("../data")
    (root / "etc/systemd").symlink_to(outside)
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 2
    assert f"leads to {outside}/system, out of {root}" in capsys.readouterr().err
    assert list(outside.iterdir()) == []
    (root / "etc/systemd").unlink()
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 0
    assert (root / "data/bin/vramctl").is_symlink()
    assert vramctl(root, "install", "--prefix", "/opt/one") == 0
    assert "nothing to change" in capsys.readouterr().out
    assert vramctl(root, "uninstall", "--purge", "--yes") == 0
    assert [name for name in tree(root) if not name.startswith("usr/local")] == []


@pytest.fixture
def systemctl(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A user with a home of their own, and a systemctl that only writes down how it is called."""
    monkeypatch.setattr("vram_arbiter.clients.cli.installation.contents.completions", lambda: SHORT)
    monkeypatch.setattr(install, "_BOOTED", tmp_path)
    program, called = tmp_path / "bin/systemctl", tmp_path / "called"
    program.parent.mkdir()
    program.write_text(f'#!/bin/sh\necho "$*" >>{called}\n')
    program.chmod(0o755)
    monkeypatch.setenv("PATH", f"{program.parent}:{os.environ['PATH']}")
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setenv("XDG_RUNTIME_DIR", str(tmp_path / "run"))
    for name in ("CONFIG", "STATE", "DATA"):
        monkeypatch.delenv(f"XDG_{name}_HOME", raising=False)
    return called


def test_a_user_installs_upgrades_and_removes(
    systemctl: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Regression: the restart that it tells of would have started an arbiter that was stopped, and
    a second removal, which has no unit left, once began to disable every unit of the machine."""
    monkeypatch.setattr(sys, "prefix", "/opt/one")
    assert run_main(["install", "--user-units", "--yes"]) == 0
    assert systemctl.read_text().splitlines()[-1] == "--user enable --now vram-arbiter.service"
    assert "next: systemctl" not in capsys.readouterr().out, "it has just been started"
    monkeypatch.setattr(sys, "prefix", "/opt/two")
    systemctl.unlink()
    assert run_main(["install", "--user-units", "--yes"]) == 0
    assert "next: systemctl --user try-restart vram-arbiter" in capsys.readouterr().out
    assert systemctl.read_text() == "--user daemon-reload\n"
    systemctl.unlink()
    assert run_main(["uninstall", "--user-units", "--yes"]) == 0
    names = "vram-gateway.service vram-reasoner.service vram-arbiter.service"
    assert systemctl.read_text().splitlines() == [
        f"--user stop {names}", f"--user disable {names}", "--user daemon-reload",
    ]  # fmt: skip
    systemctl.unlink()
    assert run_main(["uninstall", "--user-units", "--yes"]) == 0
    assert not systemctl.exists()
    assert not (tmp_path / ".config").exists()


def test_a_link_and_a_file_of_others_stay(root: Path) -> None:
    (root / "usr/local/bin").mkdir(parents=True)
    (root / "usr/local/bin/vramctl").symlink_to("/home/me/vramctl")
    (root / UNIT).parent.mkdir(parents=True)
    (root / UNIT).symlink_to("/dev/null")  # masked
    before = tree(root)
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 0
    assert tree(root).items() >= before.items()
    assert vramctl(root, "uninstall", "--yes") == 0
    assert tree(root) == before


@pytest.mark.parametrize("purge", [(), ("--purge",)])
def test_a_removal_keeps_what_was_changed_unless_it_purges(
    root: Path, purge: tuple[str, ...]
) -> None:
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 0
    (root / SIDECAR).write_text("# the operator's\n")
    (root / "etc/vram-arbiter/arbiter.yaml").write_text("gpu: {}\n")
    assert vramctl(root, "uninstall", "--yes", *purge) == 0
    left = {SIDECAR, "etc/vram-arbiter/arbiter.yaml", RECORD}
    assert set(tree(root)) == (set() if purge else left)
    assert not (root / "usr").exists(), "empty folders are gone too"
    assert vramctl(root, "uninstall") == 0, "nothing is installed"


def test_a_jetson_gets_the_device_nodes_that_it_has(root: Path) -> None:
    node = "/dev/nvgpu/igpu-0000:01:00.0/ctrl"  # Thor; on Orin the folder is igpu0
    for path in ("etc/nv_tegra_release", node.lstrip("/")):
        (root / path).parent.mkdir(parents=True, exist_ok=True)
        (root / path).touch()
    assert vramctl(root, "install", "--prefix", "/opt/one", "--yes") == 0
    assert f"DeviceAllow={node} rw\n" in (root / f"{SIDECAR}.d/tegra.conf").read_text()


def test_sshd_is_told_of_guests_where_there_is_one(root: Path) -> None:
    drop_in = root / "etc/ssh/sshd_config.d/vram-guests.conf"
    assert vramctl(root, "install", "--yes") == 0
    assert not drop_in.exists()
    drop_in.parent.mkdir(parents=True)
    assert vramctl(root, "install", "--yes") == 0
    assert "Match Group vram-guests" in drop_in.read_text()
    assert vramctl(root, "uninstall", "--yes") == 0
    assert not drop_in.exists()


@pytest.mark.parametrize(
    ("arguments", "says"),
    [
        (["install", "--root", "ROOT", "--prefix", "relative"], "expected a path"),
        (["install", "--root", "ROOT", "--prefix", "/opt/with space"], "expected a path"),
        (["install", "--root", "ROOT", "--prefix", "/opt/%n"], "expected a path"),
        (["install", "--prefix", "/opt/other"], "--prefix is for --root"),
        (["install"], "the machine's units need root"),
        (["uninstall"], "the machine's units need root"),
    ],
)
def test_what_cannot_be_installed_is_refused(
    systemctl: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    arguments: Sequence[str],
    says: str,
) -> None:
    """And without systemd nothing is, whatever the user."""
    monkeypatch.setattr(os, "getuid", lambda: 0 if "--prefix" in arguments else 1000)
    with pytest.raises(SystemExit, match="2"):
        run_main([word.replace("ROOT", str(tmp_path / "root")) for word in arguments])
    assert says in capsys.readouterr().err
    monkeypatch.setattr(install, "_BOOTED", tmp_path / "nothing")
    with pytest.raises(SystemExit, match="2"):
        run_main([arguments[0]])
    assert "systemd does not run here" in capsys.readouterr().err
    assert not systemctl.exists()


def test_a_record_of_something_else_is_not_believed(
    root: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (root / RECORD).parent.mkdir(parents=True)
    (root / RECORD).write_text('{"files": {"/etc/passwd": 3}}')
    assert vramctl(root, "uninstall", "--yes") == 2
    (root / RECORD).write_text("{}")
    (root / RECORD).chmod(0o666)
    assert vramctl(root, "uninstall", "--yes") == (2 if os.getuid() == 0 else 0)
    if os.getuid() == 0:
        assert "may be written by every user" in capsys.readouterr().err


# -- the environment that the units run
def test_a_program_that_a_user_may_change_is_not_run_by_a_unit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A link is followed step by step: the folder of any of them decides what runs."""
    environment.check_path(Path("/bin/sh"))  # a link of root's in a linked folder of root's
    link = tmp_path / "sh"
    link.symlink_to("/bin/sh")
    with pytest.raises(ConfigError, match=r"may be written by every user.*chmod go-w /tmp"):
        environment.check_path(Path("/tmp"))
    if os.getuid() == 0:
        monkeypatch.setattr(environment, "writable_by_others", owner_only)
        os.lchown(link, 12345, -1)
        with pytest.raises(ConfigError, match=f"{link} belongs to uid 12345"):
            environment.check_path(link)
    link.unlink()
    link.symlink_to(link)
    with pytest.raises(ConfigError, match=f"{link}: .*links|Symlink loop"):
        environment.check_path(link)


def test_the_libraries_of_an_interpreter_are_checked() -> None:
    """A libpython that another user may change is what the units run, wherever it lies."""
    places = environment.libraries()
    assert any(".so" in place for place in places)
    loaded = sysconfig.get_config_var("INSTSONAME")
    if sysconfig.get_config_var("Py_ENABLE_SHARED"):
        assert any(place.endswith(loaded) for place in places)


def owner_only(found: os.stat_result) -> str:
    return "" if found.st_uid == 0 else f"belongs to uid {found.st_uid}"


# -- completion
def test_no_help_shows_an_escaped_percent_sign() -> None:
    """argparse reads `%%` in the help of an argument, and leaves it in a description."""
    names = [name for name, command in COMMANDS.items() if not command.passes_on]
    assert [name for name in names if "%%" in command_parser(name).format_help()] == []


def test_completion_knows_every_command_and_its_options(
    scripts: dict[Path, str], tmp_path: Path
) -> None:
    script = tmp_path / "vramctl.bash"
    script.write_text(scripts[completing.PLACES["bash"]])
    asked = (
        'ask() { COMP_WORDS=("$@"); COMP_CWORD=$(($# - 1)); '
        '"$(complete -p vramctl | sed "s/.*-F //; s/ .*//")"; echo "${COMPREPLY[@]}"; }'
    )
    done = subprocess.run(
        [
            "bash", "-c",
            f"source {script}; {asked}; ask vramctl ''; ask vramctl evict --re; "
            "ask vramctl run --on-evict ''",
        ],
        capture_output=True, text=True, check=True,
    )  # fmt: skip
    commands, options, choices = done.stdout.splitlines()
    assert set(COMMANDS) <= set(commands.split())
    assert options == "--reason"
    assert "cuda-checkpoint" in choices.split()


@pytest.mark.parametrize("shell", ["zsh", "fish"])
def test_completion_is_a_script_of_its_shell(
    scripts: dict[Path, str], tmp_path: Path, shell: str
) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"{shell} is not installed")
    script = tmp_path / "script"
    script.write_text(scripts[completing.PLACES[shell]])
    subprocess.run([shell, "-n", str(script)], check=True)
    assert COMMANDS["top"].summary in script.read_text()
    assert "Keys: s sort" not in script.read_text(), "one line beside a word, not its whole help"
