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

from tests.packaging.test_page_blocks import unknown_flags
from tests.support.paths import ROOT
from vram_arbiter.clients.cli.installation.site import PROGRAMS, SYSTEM
from vram_arbiter.clients.cli.main import run_main

SOURCES = ROOT / "configs" / "systemd"
UNITS = (
    "vram-arbiter.service",
    "vram-sidecar@.service",
    "vram-runner@.service",
    "vram-reasoner@.service",
    "vram-reasoner.service",
)
HOLDERS = UNITS[1:]
EXPOSURES_MAX = {
    "system/vram-arbiter.service": 1.0,
    "system/vram-observer.service": 1.7,  # the network of page, collector and webhooks
    # the network of a model hub, memory that CUDA compiles into
    "system/vram-sidecar@.service": 2.0,
    "system/vram-runner@.service": 2.3,  # and cameras, motor buses and realtime scheduling
    "system/vram-reasoner@.service": 1.6,  # the network of a language model
    "system/vram-reasoner.service": 1.6,
    "system/vram-gateway.service": 2.4,  # root's uid, for units and containers of the machine
    # The tool counts what only a privileged manager can restrict, as if a user's manager could.
    "user/vram-arbiter.service": 6.2,
    "user/vram-reasoner.service": 6.5,
    "user/vram-remote@.service": 6.4,
    "user/vram-gateway.service": 9.6,  # it starts containers of the user, without limits
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
    """Files as `vramctl install` leaves them for a Jetson, whose units have one drop-in more."""
    prefix, root = tmp_path / "prefix", tmp_path / "root"
    (prefix / "bin").mkdir(parents=True)
    for program in PROGRAMS:
        (prefix / "bin" / program).symlink_to(sys.executable)
    (root / "etc").mkdir(parents=True)
    (root / "etc/nv_tegra_release").touch()
    assert run_main(["install", "--root", str(root), "--prefix", str(prefix), "--yes"]) == 0
    return root


# -- what systemd says
@needs_analyze
@pytest.mark.parametrize("name", [*UNITS, "vram-observer.service", "vram-gateway.service"])
def test_verify_is_silent(installed: Path, name: str) -> None:
    done = analyze("verify", "--man=no", str(installed / "etc/systemd/system" / name))
    assert (done.returncode, done.stdout, done.stderr) == (0, "", "")


@needs_analyze
@pytest.mark.parametrize(
    "name",
    [
        "vram-arbiter.service",
        "vram-reasoner.service",
        "vram-remote@.service",
        "vram-gateway.service",
    ],
)
def test_verify_is_silent_about_the_user_instance(
    installed: Path, tmp_path: Path, name: str
) -> None:
    path = tmp_path / name
    text = (SOURCES / "user" / name).read_text()
    path.write_text(text.replace("/opt/vram-arbiter", str(installed.parent / "prefix")))
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
def test_every_unit_is_hardened(name: str) -> None:
    """The daemon's unit alone was: those of runner, sidecar and user stood at 4.0, 3.4 and 7.5."""
    path = SOURCES / name
    done = analyze("security", "--offline=true", "--no-pager", str(path))
    found = re.search(r"Overall exposure level for [^:]+: ([0-9.]+)", done.stdout)
    assert found, done.stdout + done.stderr
    assert float(found[1]) <= EXPOSURES_MAX[name], done.stdout


@pytest.mark.parametrize("name", EXPOSURES_MAX)
def test_every_unit_may_open_many_connections(name: str) -> None:
    """1,024 descriptors, the usual limit, ended the runner."""
    kind, _, file = name.partition("/")
    assert unit(file, kind)["Service", "LimitNOFILE"] == ["65536"]


def test_the_units_reach_the_gpu_of_a_jetson(installed: Path) -> None:
    for name in ("vram-arbiter.service", "vram-sidecar@.service", "vram-runner@.service"):
        drop_in = installed / f"etc/systemd/system/{name}.d/tegra.conf"
        allowed = settings_of(drop_in.read_text())["Service", "DeviceAllow"]
        for device in ("nvmap", "nvhost-gpu", "nvhost-ctrl-gpu", "nvgpu/igpu0/channel"):
            assert f"/dev/{device} rw" in allowed
        assert settings_of(drop_in.read_text())["Service", "SupplementaryGroups"] == [
            "video render"
        ]


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


@pytest.mark.parametrize("name", [*HOLDERS, "vram-gateway.service"])
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


def test_other_processes_stay_visible_and_the_gpus_reachable() -> None:
    found = unit("vram-arbiter.service")
    assert found["Service", "ProtectProc"] == ["default"]
    assert found["Service", "ProcSubset"] == ["all"]
    assert found["Service", "PrivateUsers"] == ["no"], "SO_PEERCRED would show everybody as nobody"
    assert found["Service", "PrivateDevices"] == ["no"]
    assert "char-nvidia* rw" in found["Service", "DeviceAllow"]
    assert "AF_UNIX" in found["Service", "RestrictAddressFamilies"][0]
    for name, needed in (("kill", "CAP_KILL"), ("drm", "CAP_PERFMON CAP_SYS_PTRACE")):
        example = SOURCES / f"system/vram-arbiter.service.d/{name}.conf.example"
        added = settings_of(example.read_text())
        assert added["Service", "AmbientCapabilities"] == [needed]
        assert added["Service", "CapabilityBoundingSet"] == [needed]
    assert found["Service", "AmbientCapabilities"] == [""], (
        "opt-in means that it is not there by itself"
    )
    assert found["Service", "PrivateNetwork"] == ["yes"]
    assert found["Service", "RestrictAddressFamilies"] == ["AF_UNIX"]


def test_the_observer_reaches_loopback_alone() -> None:
    found = unit("vram-observer.service")
    assert found["Service", "IPAddressDeny"] == ["any"]
    assert found["Service", "IPAddressAllow"] == ["localhost"]
    assert "AF_NETLINK" in found["Service", "RestrictAddressFamilies"][0], "whose a connection is"


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


def test_a_purge_knows_every_folder_of_the_units() -> None:
    roots = {
        "StateDirectory": Path("/var/lib"),
        "CacheDirectory": Path("/var/cache"),
        "RuntimeDirectory": Path("/run"),
    }
    written = set()
    for path in (SOURCES / "system").glob("*.service"):
        found = settings_of(path.read_text(encoding="utf-8"))
        for key, root in roots.items():
            for name in found.get(("Service", key), []):
                written.add(root / name)
                if ("Service", "DynamicUser") in found:  # the folder's name leads there
                    written.add(root / "private" / name)
    assert written <= set(SYSTEM.trees())


def test_the_flags_of_the_units_are_understood() -> None:
    """`ExecStart=` is a command line of ours: its options are those of the programs."""
    for name in (*UNITS, "vram-gateway.service"):
        (line,) = unit(name)["Service", "ExecStart"]
        path, *arguments = line.replace("%i", "sim").split()
        assert unknown_flags(Path(path).name, arguments) == [], name


# -- users and folders
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


def test_the_page_names_every_unit() -> None:
    page = (ROOT / "docs/how-to/systemd.md").read_text(encoding="utf-8")
    for name in (*UNITS, "usermod", "journalctl", "vramctl install", "--user-units"):
        assert name.removesuffix(".service").removesuffix("@") in page
