"""The units as systemd's own tools see them, and what must hold for them whatever those tools
think.

Nothing here is started and nothing is written outside the test's folder: `verify` and `security
--offline` only read, and the tools that create users and folders are always given a root of their
own.
"""

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from vram_arbiter.schemas.config.arbiter import load_config

TREE = Path(__file__).parents[2]
SOURCES = TREE / "configs" / "systemd"
UNITS = (
    "vram-arbiter.service",
    "vram-sidecar@.service",
    "vram-runner@.service",
    "vram-reasoner@.service",
)
HOLDERS = UNITS[1:]
EXPOSURES_MAX = {
    "system/vram-arbiter.service": 1.0,
    # the network of a model hub, memory that CUDA compiles into
    "system/vram-sidecar@.service": 2.0,
    "system/vram-runner@.service": 2.3,  # and cameras, motor buses and realtime scheduling
    "system/vram-reasoner@.service": 1.6,  # the network of a language model
    # The tool counts what only a privileged manager can restrict, as if a user's manager could.
    "user/vram-arbiter.service": 6.2,
}
"""Figures of systemd 252. Each unit is at most 0.1 below its limit, so that a setting that goes
missing shows."""

needs_analyze = pytest.mark.skipif(
    shutil.which("systemd-analyze") is None,
    reason="systemd-analyze is not installed: Debian's package systemd",
)
Settings = dict[tuple[str, str], list[str]]


def settings_of(text: str) -> Settings:
    """(section, key) → values in their order; a key may come several times."""
    found: Settings = {}
    section = ""
    for line in text.splitlines():
        if line.startswith("["):
            section = line.strip("[]")
        elif line and not line.startswith(("#", ";")):
            key, _, value = line.partition("=")
            found.setdefault((section, key), []).append(value)
    return found


def unit(name: str, kind: str = "system") -> Settings:
    return settings_of((SOURCES / kind / name).read_text(encoding="utf-8"))


@pytest.fixture
def installed(tmp_path: Path) -> Path:
    """Units as the installer leaves them, for a prefix in which the programs are there."""
    prefix = tmp_path / "prefix"
    (prefix / "bin").mkdir(parents=True)
    for program in ("vram-arbiter", "vram-sidecar", "vram-runner", "vram-reasoner"):
        (prefix / "bin" / program).symlink_to(sys.executable)
    done = install(str(prefix), str(tmp_path / "root"))
    assert (done.returncode, done.stderr) == (0, "")
    return tmp_path / "root"


def install(*arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [str(TREE / ".ci" / "install-units"), *arguments],
        capture_output=True,
        text=True,
        timeout=60,
    )


# -- what systemd says
@needs_analyze
@pytest.mark.parametrize("name", UNITS)
def test_verify_is_silent(installed: Path, name: str) -> None:
    done = analyze("verify", "--man=no", str(installed / "etc/systemd/system" / name))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@needs_analyze
def test_verify_is_silent_about_the_user_instance(installed: Path, tmp_path: Path) -> None:
    path = installed / "etc/systemd/user/vram-arbiter.service"
    done = analyze("--user", "verify", "--man=no", str(path), XDG_RUNTIME_DIR=str(tmp_path))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@needs_analyze
def test_verify_would_speak_up(installed: Path) -> None:
    """The check can fail: a mistyped key is a line on stderr."""
    path = installed / "etc/systemd/system/vram-arbiter.service"
    path.write_text(path.read_text().replace("WatchdogSec=", "WatchdogSecs="))
    assert "WatchdogSecs" in analyze("verify", "--man=no", str(path)).stderr


@needs_analyze
@pytest.mark.parametrize("name", EXPOSURES_MAX)
def test_every_unit_is_hardened(installed: Path, name: str) -> None:
    """The daemon's unit alone was: those of runner, sidecar and user stood at 4.0, 3.4 and 7.5."""
    path = installed / "etc/systemd" / name
    done = analyze("security", "--offline=true", "--no-pager", str(path))
    found = re.search(r"Overall exposure level for [^:]+: ([0-9.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= EXPOSURES_MAX[name], done.stdout


@pytest.mark.parametrize("name", EXPOSURES_MAX)
def test_every_unit_may_open_many_connections(name: str) -> None:
    """1,024 descriptors, the usual limit, ended the runner."""
    kind, _, file = name.partition("/")
    assert unit(file, kind)["Service", "LimitNOFILE"] == ["65536"]


def test_a_sidecar_reaches_the_gpu_of_a_jetson() -> None:
    allowed = unit("vram-sidecar@.service")["Service", "DeviceAllow"]
    for device in (
        "/dev/nvmap",
        "/dev/nvhost-gpu",
        "/dev/nvhost-ctrl-gpu",
        "/dev/nvgpu/igpu0/channel",
    ):
        assert f"{device} rw" in allowed
    assert "video" in unit("vram-sidecar@.service")["Service", "SupplementaryGroups"][0]


def test_the_runner_reaches_cameras_buses_and_realtime() -> None:
    found = unit("vram-runner@.service")
    for device in ("char-video4linux", "char-ttyACM", "char-ttyUSB", "char-drm", "char-nvidia*"):
        assert f"{device} rw" in found["Service", "DeviceAllow"]
    assert found["Service", "LimitRTPRIO"] == ["1"]
    assert ("Service", "RestrictRealtime") not in found


def analyze(*arguments: str, **environ: str) -> subprocess.CompletedProcess[str]:
    plain = {
        **os.environ,
        "LC_ALL": "C",
        "SYSTEMD_LOG_LEVEL": "warning",
        "SYSTEMD_COLORS": "0",
        **environ,
    }
    return subprocess.run(
        ["systemd-analyze", *arguments], env=plain, capture_output=True, text=True, timeout=60
    )


# -- a stop of the arbiter stops nobody
STOPPING_TIES = ("Requires", "Requisite", "BindsTo", "PartOf", "PropagatesStopTo",
"StopPropagatedFrom",
                 "PropagatesReloadTo", "Conflicts", "Upholds", "JoinsNamespaceOf",
                 "OnFailure")  # fmt: skip


@pytest.mark.parametrize("name", HOLDERS)
def test_holders_want_the_arbiter_and_nothing_more(name: str) -> None:
    found = unit(name)
    assert found["Unit", "Wants"] == ["vram-arbiter.service"]
    assert "vram-arbiter.service" in found["Unit", "After"]
    assert not [key for section, key in found if key in STOPPING_TIES]


@pytest.mark.parametrize("kind", ["system", "user"])
def test_the_arbiter_pulls_nobody_down_with_it(kind: str) -> None:
    found = unit("vram-arbiter.service", kind)
    assert not [key for section, key in found if key in STOPPING_TIES]
    assert found["Service", "RuntimeDirectoryPreserve"] == ["yes"], "holders' sockets lie in it"


# -- what the daemon needs to be allowed
def test_the_watchdog_is_on_and_the_daemon_speaks_for_itself() -> None:
    for kind in ("system", "user"):
        found = unit("vram-arbiter.service", kind)
        assert found["Service", "Type"] == ["notify"]
        assert found["Service", "NotifyAccess"] == ["main"]
        assert 5 <= int(found["Service", "WatchdogSec"][0]) <= 60
        assert found["Service", "Restart"] == ["on-failure"]
        assert found["Service", "RestartPreventExitStatus"] == ["2 3"], (
            "a full disk or a driver may come round"
        )


def test_other_processes_stay_visible_and_the_cards_reachable() -> None:
    found = unit("vram-arbiter.service")
    assert found["Service", "ProtectProc"] == ["default"]
    assert found["Service", "ProcSubset"] == ["all"]
    assert found["Service", "PrivateUsers"] == ["no"], "SO_PEERCRED would show everybody as nobody"
    assert found["Service", "PrivateDevices"] == ["no"]
    assert "char-nvidia* rw" in found["Service", "DeviceAllow"]
    assert "AF_UNIX" in found["Service", "RestrictAddressFamilies"][0]
    kill = settings_of((SOURCES / "system/vram-arbiter.service.d/kill.conf.example").read_text())
    assert kill["Service", "AmbientCapabilities"] == ["CAP_KILL"]
    assert found["Service", "AmbientCapabilities"] == [""], (
        "opt-in means that it is not there by itself"
    )
    online = settings_of(
        (SOURCES / "system/vram-arbiter.service.d/telemetry.conf.example").read_text()
    )
    assert (online["Service", "IPAddressAllow"], found["Service", "IPAddressDeny"]) == (
        ["localhost"],
        ["any"],
    )
    assert found["Service", "PrivateNetwork"] == ["yes"]


def test_all_programs_meet_in_one_folder() -> None:
    arbiter = unit("vram-arbiter.service")
    assert arbiter["Service", "RuntimeDirectory"] == ["vram-arbiter"]
    mode = arbiter["Service", "RuntimeDirectoryMode"][0]
    snippet = (SOURCES / "tmpfiles.d/vram-arbiter.conf").read_text()
    assert f"d /run/vram-arbiter {mode} vram-arbiter vram-arbiter" in snippet
    for name in HOLDERS:
        found = unit(name)
        assert "VRAM_ARBITER_RUNTIME=/run/vram-arbiter" in found["Service", "Environment"]
        assert found["Service", "Group"] == ["vram-arbiter"]


def test_every_user_of_a_unit_is_created() -> None:
    created = re.findall(
        r"^u (\S+)", (SOURCES / "sysusers.d/vram-arbiter.conf").read_text(), re.MULTILINE
    )
    used = {unit(name)["Service", "User"][0] for name in UNITS}
    assert used == set(created)


def test_the_flags_of_the_units_are_understood(tmp_path: Path) -> None:
    """`ExecStart=` is a command line of ours: its options are those of the programs."""
    for name in UNITS:
        (line,) = unit(name)["Service", "ExecStart"]
        program = Path(line.split()[0]).name.removeprefix("vram-")
        package = {"arbiter": "arbiter", "sidecar": "sidecars"}.get(program, program)
        arguments = ["sim", "--help"] if program == "runner" else ["--help"]
        done = subprocess.run(
            [sys.executable, "-m", f"vram_arbiter.{package}", *arguments],
            env={**os.environ, "PYTHONPATH": str(TREE / "src")}, cwd=tmp_path,
            capture_output=True, text=True, timeout=60, check=True,
        )  # fmt: skip
        for flag in re.findall(r"--[a-z-]+", line):
            assert flag in done.stdout, f"{name}: {flag}"


# -- the installer, users and folders
def test_the_prefix_takes_the_place_of_the_usual_one(installed: Path) -> None:
    for path in sorted(installed.rglob("*.service")):
        text = path.read_text()
        assert "/opt/vram-arbiter" not in text
        assert f"ExecStart={installed.parent}/prefix/bin/vram-" in text
        assert path.stat().st_mode & 0o777 == 0o644
    assert {path.name for path in (installed / "etc").iterdir()} == {
        "systemd",
        "sysusers.d",
        "tmpfiles.d",
    }


def test_the_installer_refuses_what_cannot_work(tmp_path: Path) -> None:
    assert install().returncode != 0
    assert "absolute path" in install("relative", str(tmp_path)).stderr
    assert "install the product first" in install(str(tmp_path / "nothing")).stderr
    # A Python of pyenv or uv is below the home folder of its user; systemd said only 203/EXEC.
    programs = tmp_path / "prefix" / "bin"
    programs.mkdir(parents=True)
    (programs / "vram-arbiter").symlink_to(sys.executable)
    (programs / "python").symlink_to("/home/python3.12")
    warned = install(
        str(tmp_path / "prefix"), str(tmp_path / "root")
    )  # without a root of its own it is refused
    assert "the system's units cannot read /home/python3.12" in warned.stderr


@pytest.mark.skipif(
    shutil.which("systemd-sysusers") is None or os.getuid() != 0,
    reason="needs root and systemd-sysusers",
)
def test_users_and_folders_are_made_below_a_root_of_their_own(installed: Path) -> None:
    """Always with --root and a single snippet: without, these tools would work on the machine
    itself."""

    def below_root(*command: str, snippet: Path) -> None:
        done = subprocess.run(
            [command[0], f"--root={installed}", *command[1:], "-"],
            input=snippet.read_text(), capture_output=True, text=True, timeout=60,
        )  # fmt: skip
        assert done.returncode == 0, done.stderr

    below_root("systemd-sysusers", snippet=installed / "etc/sysusers.d/vram-arbiter.conf")
    users = dict(line.split(":", 1) for line in (installed / "etc/passwd").read_text().splitlines())
    assert {"vram-arbiter", "vram-sidecar", "vram-robot"} <= users.keys()
    groups = {
        line.split(":")[0]: line.split(":")[3]
        for line in (installed / "etc/group").read_text().splitlines()
    }
    assert set(groups["vram-arbiter"].split(",")) == {"vram-sidecar", "vram-robot"}

    below_root(
        "systemd-tmpfiles", "--create", snippet=installed / "etc/tmpfiles.d/vram-arbiter.conf"
    )
    folder = (installed / "run/vram-arbiter").stat()
    assert folder.st_mode & 0o7777 == 0o1770
    assert folder.st_uid == int(users["vram-arbiter"].split(":")[1])


def test_the_page_names_every_unit_and_the_example_configuration_loads() -> None:
    page = (TREE / "docs" / "systemd.md").read_text(encoding="utf-8")
    for name in (*UNITS, "usermod", "journalctl", "install-units", "systemctl --user"):
        assert name.removesuffix(".service").removesuffix("@") in page
    for block in re.findall(r"```yaml\n(.*?)```", page, re.DOTALL):
        load_config(block, "docs/systemd.md")
