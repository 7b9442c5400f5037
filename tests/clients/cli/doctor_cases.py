"""Machines for the tests of `vramctl doctor`: a sound one, and each case of what may be wrong."""

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from vram_arbiter.clients.cli.doctor.machine import Arbiter, Machine, Nvml
from vram_arbiter.schemas.defaults import GIB
from vram_arbiter.schemas.errors import ArbiterUnreachable, UntrustedServer
from vram_arbiter.schemas.wire.codes import Block
from vram_arbiter.schemas.wire.errors import ErrorView
from vram_arbiter.schemas.wire.replies import StatusReply
from vram_arbiter.schemas.wire.views import BlockView, GpuView, HostRamView, ProcessView, Totals

PID, UID, OTHER = 700, 4242, 4243
SOCKET = "/run/vram-arbiter/arbiter.sock"
UNIT = "[Service]\nExecStart=/opt/vram-arbiter/bin/vram-arbiter --group vram-arbiter\n"
UNIX = "Num RefCount Protocol Flags Type St Inode Path\n"
SOUND: Mapping[str, str] = {
    "/proc/driver/nvidia/version": "NVRM version: NVIDIA UNIX x86_64  580.95.05  Tue Sep 23\n",
    "/proc/driver/nvidia/params": "PreserveVideoMemoryAllocations: 1\n",
    "/sys/power/state": "freeze mem disk\n",
    "/dev/nvidiactl": "",
    "/dev/nvidia0": "",
    "/dev/nvidia-uvm": "",
    "/run/systemd/system/x": "",
    SOCKET: "",
    "/proc/net/unix": f"{UNIX}0: 00000002 00000000 00010000 0001 01 55 {SOCKET}\n",
    f"/proc/{PID}/oom_score_adj": "-500\n",
    "/opt/vram-arbiter/bin/vram-arbiter": "",
    "/etc/systemd/system/vram-arbiter.service": UNIT,
    "/etc/systemd/system/multi-user.target.wants/vram-arbiter.service": "",
    **{
        f"/etc/systemd/system/systemd-suspend.service.requires/{unit}.service": ""
        for unit in ("nvidia-suspend", "nvidia-resume", "nvidia-hibernate")
    },
}
GPU = GpuView("GPU-1", 0, "RTX", "nvml", 8 * GIB, 0, 0, 0, 0, 0.1, 0, None, ())
STOWAWAY = ProcessView(77, "notebook", GIB, (), 0, 0, True)
STATUS = StatusReply(
    1, "serving", 5.0, (GPU,), (), Totals(0, 0), 2, HostRamView(8 * GIB, 0), "", ()
)
SILENT = ArbiterUnreachable("no arbiter answers", hint="look")


def lay(root: Path, files: Mapping[str, str | None]) -> None:
    """Write files below a folder; None removes one."""
    for name, text in files.items():
        place = root / name.lstrip("/")
        if text is None:
            place.unlink()
        else:
            place.parent.mkdir(parents=True, exist_ok=True)
            place.write_text(text)


def sound(root: Path) -> Machine:
    """A machine on which nothing is wrong."""
    lay(root, SOUND)
    for name in (SOCKET, "/dev/nvidiactl", "/dev/nvidia0", "/dev/nvidia-uvm"):
        (root / name.lstrip("/")).chmod(0o660)
    (root / "run/vram-arbiter").chmod(0o1770)
    gid = (root / SOCKET.lstrip("/")).stat().st_gid
    return Machine(
        endpoint=f"ipc://{SOCKET}",
        arbiter=Arbiter(STATUS, "vram-arbiter 0.2.0", PID, OTHER),
        version="0.2.0",
        nvml=Nvml("580.95.05", 1),
        root=root,
        environ={"HOME": "/home/op"},
        uid=UID,
        gids=frozenset({gid}),
        group_name=lambda gid: "vram-arbiter",
        group_members=lambda name: ("op",),
        user_name=lambda uid: {UID: "op", OTHER: "vram-arbiter"}.get(uid, str(uid)),
    )


# -- what is wrong, case by case
@dataclass(frozen=True)
class Case:
    """What is wrong, by `files` and by fields of the machine, and a part of the command that mends
    it."""

    code: str
    fix: str
    files: Mapping[str, str | None] = ()  # type: ignore[assignment]
    change: Callable[[Machine], Machine] = lambda m: m

    def __str__(self) -> str:
        return self.code


def status(**fields: Any) -> Callable[[Machine], Machine]:
    return lambda m: replace(m, arbiter=replace(m.arbiter, status=replace(STATUS, **fields)))


def gpu_with(**fields: Any) -> Callable[[Machine], Machine]:
    return status(gpus=(replace(GPU, **fields),))


def arbiter_of(**fields: Any) -> Callable[[Machine], Machine]:
    return lambda m: replace(m, arbiter=replace(m.arbiter, **fields))


def field(**fields: Any) -> Callable[[Machine], Machine]:
    return lambda m: replace(m, **fields)


def silent(m: Machine) -> Machine:
    return replace(m, arbiter=Arbiter(problem=SILENT))


def mode(name: str, bits: int, change: Callable[[Machine], Machine] = lambda m: m) -> Any:
    def changed(m: Machine) -> Machine:
        m.path(name).chmod(bits)
        return change(m)

    return changed


def elsewhere(m: Machine) -> Machine:
    return replace(
        m,
        endpoint="ipc:///run/user/4242/vram-arbiter/arbiter.sock",
        arbiter=Arbiter(problem=SILENT),
    )


def masked(m: Machine) -> Machine:
    place = m.path("/etc/systemd/system/vram-arbiter.service")
    place.unlink()
    place.symlink_to("/dev/null")
    return m


USER_UNIT = {
    "/home/op/.config/systemd/user/vram-arbiter.service": UNIT,
    "/home/op/.config/systemd/user/default.target.wants/vram-arbiter.service": "",
}
PCI = "/sys/bus/pci/devices/0000:01:00.0"
GONE: Mapping[str, str | None] = {"/proc/driver/nvidia/version": None}
NOT_FOUND = field(
    nvml=Nvml(problem="NVML Shared Library Not Found", error="NVMLError_LibraryNotFound")
)

CASES = [
    Case("versions.differ", "restart vram-arbiter", change=arbiter_of(server="vram-arbiter 0.1.0")),
    Case("versions.wire", "restart vram-arbiter",
        change=arbiter_of(
            status=None, refusal=ErrorView("version_mismatch", "wire 3, not 4", "", {})
        )),
    Case("driver.mismatch", "reboot",
        change=field(nvml=Nvml(problem="x", error="NVMLError_LibRmVersionMismatch"))),
    Case("driver.broken", "nvidia-smi",
        change=field(nvml=Nvml(problem="Unknown Error", error="NVMLError_Unknown"))),
    Case("driver.not-loaded", "modprobe nvidia",
        {**GONE, f"{PCI}/vendor": "0x10de\n", f"{PCI}/class": "0x030000\n"}, NOT_FOUND),
    Case("driver.none", "fake:8GiB", GONE, NOT_FOUND),
    Case("driver.other", "--gpu drm",
        {**GONE, "/sys/class/drm/card0/device/uevent": "DRIVER=amdgpu\nPCI_CLASS=30000\n"},
        NOT_FOUND),
    Case("devices.missing", "nvidia-modprobe", {"/dev/nvidia-uvm": None}),
    Case("devices.closed", "usermod --append --groups", change=mode("/dev/nvidia0", 0o600)),
    Case("suspend.memory-lost", "NVreg_PreserveVideoMemoryAllocations=1",
        {"/proc/driver/nvidia/params": "PreserveVideoMemoryAllocations: 0\n"}),
    Case("suspend.units", "systemctl enable nvidia-resume",
        {"/etc/systemd/system/systemd-suspend.service.requires/nvidia-resume.service": None}),
    Case("socket.endpoint", "export VRAM_ARBITER_ENDPOINT",
        change=field(endpoint="tcp://127.0.0.1:1")),
    Case("socket.untrusted", "VRAM_ARBITER_SERVER_USERS",
        change=arbiter_of(problem=UntrustedServer("served by uid 5"))),
    Case("socket.elsewhere", "ipc:///run/vram-arbiter/arbiter.sock", change=elsewhere),
    Case("socket.missing", "systemctl start vram-arbiter", {SOCKET: None}, silent),
    Case("socket.closed", "usermod", change=mode(SOCKET, 0o600, silent)),
    Case("socket.closed", "usermod --append --groups vram-arbiter op",
        change=lambda m: replace(silent(m), gids=frozenset({9}))),
    Case("socket.dead", "systemctl start vram-arbiter", {"/proc/net/unix": UNIX}, silent),
    Case("socket.silent", "systemctl restart vram-arbiter", change=silent),
    Case("permissions.socket", "chmod 0660", change=mode(SOCKET, 0o666)),
    Case("permissions.folder", "chmod 1770", change=mode("/run/vram-arbiter", 0o777)),
    Case("permissions.session", "newgrp", change=field(gids=frozenset({9}))),
    Case("permissions.group", "usermod",
        change=field(gids=frozenset({9}), group_members=lambda name: ())),
    Case("permissions.root", "systemctl start", change=arbiter_of(uid=0)),
    Case("operators.may-not", "vram-operators op", change=field(group_members=lambda name: ())),
    Case("daemon.refuses", "wait",
        change=arbiter_of(status=None, refusal=ErrorView("limit_exceeded", "full", "wait", {}))),
    Case("daemon.files", "df -h", change=status(problems=("the journal cannot be written",))),
    Case("daemon.drained", "vramctl resume", change=status(drained="op: driver")),
    Case("probe.none", "nvidia-smi", change=status(gpus=())),
    Case("probe.unreadable", "nvidia-smi", change=gpu_with(measured_used_bytes=None)),
    Case("probe.pressure", "--kind pressure", change=gpu_with(pressure_bytes=GIB)),
    Case("probe.blocked", "vramctl status",
        change=gpu_with(blocked=BlockView(Block.LOADING, text="x loads"))),
    Case("stowaways.process", "kill 77; vramctl run --vram 1GiB -- python train.py",
        {"/proc/77/cmdline": "python\0train.py\0"}, gpu_with(processes=(STOWAWAY,))),
    Case("oom.score", f"tee /proc/{PID}/oom_score_adj", {f"/proc/{PID}/oom_score_adj": "0\n"}),
    Case("units.missing", "vramctl install",
        {name: None for name in SOUND if name.endswith("/vram-arbiter.service")}),
    Case("units.both", "systemctl --user disable", USER_UNIT),
    Case("units.disabled", "systemctl enable --now",
        {"/etc/systemd/system/multi-user.target.wants/vram-arbiter.service": None}),
    Case("units.masked-system", "unmask", change=masked),
    Case("units.program-system", "vramctl install", {"/opt/vram-arbiter/bin/vram-arbiter": None}),
]  # fmt: skip
