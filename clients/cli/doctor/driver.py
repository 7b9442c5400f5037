"""Checks of the NVIDIA driver: its module and library, device nodes, and suspend."""

import os
import re
from collections.abc import Iterator
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import (
    CouldNotLook,
    Finding,
    error,
    note,
    ok,
    warning,
)
from vram_arbiter.clients.cli.doctor.machine import Machine

VERSION: Final = "/proc/driver/nvidia/version"
PARAMS: Final = "/proc/driver/nvidia/params"
NVIDIA: Final = "0x10de"
CARDS: Final = "/sys/class/drm"
SLEEP_UNITS: Final = ("nvidia-suspend.service", "nvidia-resume.service", "nvidia-hibernate.service")
NODES: Final = ("/dev/nvidiactl", "/dev/nvidia0", "/dev/nvidia-uvm")
UNITS: Final = "/etc/systemd/system"


def driver(m: Machine) -> Iterator[Finding]:
    """The kernel module is loaded and NVIDIA's library fits it."""
    loaded, nvml = m.text(VERSION), m.nvml
    found = re.search(r"\b\d+\.\d+(\.\d+)?\b", loaded or "")
    module = f"the kernel module {found[0] if found else 'of an unknown version'}"
    if nvml.problem == "":
        memory = ", memory shared with the CPU (source unified)" if nvml.without_memory else ""
        yield ok("driver.works", f"NVIDIA {nvml.version}, {nvml.gpus} GPU(s){memory}")
    elif "Mismatch" in nvml.error:
        what = f"{module} is older or newer than NVIDIA's library ({nvml.problem})"
        why = "the driver was upgraded, but the machine was not restarted"
        yield error("driver.mismatch", f"{what}: {why}", f"{m.sudo}reboot")
    elif m.exists("/dev/nvmap") or m.exists("/etc/nv_tegra_release"):
        yield ok("driver.tegra", "a Jetson: its GPU uses the machine's memory (source unified)")
    elif loaded is not None:
        what = f"{module} is loaded, NVML fails: {nvml.problem}"
        yield error("driver.broken", what, "nvidia-smi")
    elif (bound := _gpu_without_driver(m)) is not None:
        held = f", the driver {bound} has it" if bound else ""
        what = f"there is an NVIDIA GPU and the module nvidia is not loaded{held}"
        yield error("driver.not-loaded", what, f"{m.sudo}modprobe nvidia")
    elif others := [name for name in m.names(CARDS) if _is_read_by_drm(m, name)]:
        what = f"no NVIDIA GPU; {len(others)} of AMD or Intel, which the source drm reads"
        yield note("driver.other", what, "vram-arbiter --gpu drm")
    else:
        what = f"no NVIDIA GPU and no driver ({nvml.problem}); use a simulated GPU"
        yield note("driver.none", what, "vram-arbiter --gpu fake:8GiB")


def devices(m: Machine) -> Iterator[Finding]:
    """The device nodes exist and may be opened by programs of this user."""
    if m.text(VERSION) is None:
        raise CouldNotLook(f"{VERSION} is not there: no driver, or a Jetson's or WSL's")
    if missing := [node for node in NODES if not m.exists(node)]:
        what = f"device nodes are missing: {', '.join(missing)}; the arbiter may not create them"
        yield error("devices.missing", what, f"{m.sudo}nvidia-modprobe -c 0 -u")
    found = {node: there for node in NODES if (there := m.stat(node)) is not None}
    if closed := [node for node, there in found.items() if not m.may(there, 0o6)]:
        group = m.group_name(found[closed[0]].st_gid)
        what = f"uid {m.uid} may not open {', '.join(closed)} (group {group})"
        join = f"{m.sudo}usermod --append --groups {group} {m.user_name(m.uid)}"
        yield error("devices.closed", what, join)


def suspend(m: Machine) -> Iterator[Finding]:
    """GPU memory survives a suspend of the machine."""
    states = set((m.text("/sys/power/state") or "").split())
    masked = (m.path(f"{UNITS}/{name}.target") for name in ("sleep", "suspend"))
    if not {"mem", "disk"} & states or any(
        place.is_symlink() and os.readlink(place) == "/dev/null" for place in masked
    ):
        return
    text = m.text(PARAMS)
    if text is None:
        raise CouldNotLook(f"{PARAMS} is not there: no driver, or a Jetson's or WSL's")
    params = dict(line.split(": ", 1) for line in text.splitlines() if ": " in line)
    if params.get("UseKernelSuspendNotifiers") == "1":
        return  # the driver saves GPU memory itself
    if params.get("PreserveVideoMemoryAllocations") != "1":
        options = (
            "options nvidia NVreg_PreserveVideoMemoryAllocations=1 NVreg_TemporaryFilePath=/var/tmp"
        )
        yield warning(
            "suspend.memory-lost",
            "GPU memory is lost at a suspend (PreserveVideoMemoryAllocations is off): resident "
            "models fail after it",
            f"echo '{options}' | {m.sudo}tee /etc/modprobe.d/nvidia-suspend.conf && "
            f"{m.sudo}update-initramfs -u && {m.sudo}reboot",
        )
        return
    folders = [f"{UNITS}/{name}" for name in m.names(UNITS) if name.startswith("systemd-")]
    off = [
        unit for unit in SLEEP_UNITS if not any(m.exists(f"{place}/{unit}") for place in folders)
    ]
    if off:
        what = f"GPU memory should be kept in a suspend, but {', '.join(off)} cannot: not enabled"
        fails = "the machine may not suspend, or not resume"
        fix = f"{m.sudo}systemctl enable {' '.join(off)}"
        yield warning("suspend.units", f"{what}: {fails}", fix)


def _gpu_without_driver(m: Machine) -> str | None:
    """Return the driver that an NVIDIA display device has, "" for none; None: no such device."""
    for name in m.names("/sys/bus/pci/devices"):
        device = f"/sys/bus/pci/devices/{name}"
        vendor, kind = m.text(f"{device}/vendor") or "", m.text(f"{device}/class") or ""
        if vendor.strip() == NVIDIA and kind.startswith("0x03"):
            bound = m.path(f"{device}/driver")
            return os.path.basename(os.readlink(bound)) if bound.is_symlink() else ""
    return None


def _is_read_by_drm(m: Machine, card: str) -> bool:
    uevent = m.text(f"{CARDS}/{card}/device/uevent") or ""
    return card.startswith("card") and bool({"DRIVER=amdgpu", "DRIVER=xe"} & {*uevent.split()})
