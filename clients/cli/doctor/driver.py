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
SLEEP_UNITS: Final = ("nvidia-suspend.service", "nvidia-resume.service", "nvidia-hibernate.service")
NODES: Final = ("/dev/nvidiactl", "/dev/nvidia0", "/dev/nvidia-uvm")


def driver(m: Machine) -> Iterator[Finding]:
    """The kernel module is loaded and NVIDIA's library fits it."""
    loaded = m.text(VERSION)
    if m.nvml.problem == "":
        memory = ", memory shared with the CPU (source unified)" if m.nvml.without_memory else ""
        count = f"{m.nvml.gpus} GPU" + ("" if m.nvml.gpus == 1 else "s")
        yield ok("driver.works", f"NVIDIA {m.nvml.version}, {count}{memory}")
    elif "Mismatch" in m.nvml.error:
        yield error(
            "driver.mismatch",
            f"the loaded kernel module {_version(loaded)} is older or newer than NVIDIA's library "
            f"({m.nvml.problem}): the driver was upgraded, but the machine was not restarted",
            f"{m.sudo}reboot",
        )
    elif m.exists("/dev/nvmap") or m.exists("/etc/nv_tegra_release"):
        yield ok("driver.tegra", "a Jetson: its GPU uses the machine's memory (source unified)")
    elif loaded is None and (bound := _gpu_without_driver(m)) is not None:
        held = f", the driver {bound} has it" if bound else ""
        yield error(
            "driver.not-loaded",
            f"there is an NVIDIA GPU and the module nvidia is not loaded{held}",
            f"{m.sudo}modprobe nvidia",
        )
    elif loaded is not None:
        yield error(
            "driver.broken",
            f"the kernel module {_version(loaded)} is loaded, NVML fails: {m.nvml.problem}",
            "nvidia-smi",
        )
    else:
        yield note(
            "driver.none",
            f"no NVIDIA GPU and no driver ({m.nvml.problem}); use a simulated GPU",
            "vram-arbiter --gpu fake:8GiB",
        )


def devices(m: Machine) -> Iterator[Finding]:
    """The device nodes exist and may be opened by programs of this user."""
    if m.text(VERSION) is None:
        raise CouldNotLook(f"{VERSION} is not there: no driver, or a Jetson's or WSL's")
    missing = [node for node in NODES if not m.exists(node)]
    if missing:
        yield error(
            "devices.missing",
            f"device nodes are missing: {', '.join(missing)}; the arbiter may not create them",
            f"{m.sudo}nvidia-modprobe -c 0 -u",
        )
    found = {node: there for node in NODES if (there := m.stat(node)) is not None}
    closed = [node for node, there in found.items() if not m.may(there, 0o6)]
    if closed:
        group = m.group_name(found[closed[0]].st_gid)
        yield error(
            "devices.closed",
            f"uid {m.uid} may not open {', '.join(closed)} (group {group})",
            f"{m.sudo}usermod --append --groups {group} {m.user_name(m.uid)}",
        )
    if not missing and not closed:
        yield ok("devices.open", f"{', '.join(NODES)} may be opened")


def suspend(m: Machine) -> Iterator[Finding]:
    """GPU memory survives a suspend of the machine."""
    states = (m.text("/sys/power/state") or "").split()
    if not {"mem", "disk"} & set(states):
        yield ok("suspend.none", "this machine does not suspend")
        return
    if _is_masked(m, "sleep.target") or _is_masked(m, "suspend.target"):
        yield ok("suspend.masked", "suspend is masked")
        return
    text = m.text(PARAMS)
    if text is None:
        raise CouldNotLook(f"{PARAMS} is not there: no driver, or a Jetson's or WSL's")
    params = dict(line.split(": ", 1) for line in text.splitlines() if ": " in line)
    if params.get("UseKernelSuspendNotifiers") == "1":
        yield ok("suspend.kept", "the driver saves GPU memory itself (kernel suspend notifiers)")
        return
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
    off = [unit for unit in SLEEP_UNITS if not _sleep_unit_enabled(m, unit)]
    if off:
        yield warning(
            "suspend.units",
            f"GPU memory should be kept in a suspend, but {', '.join(off)} "
            f"{'is' if len(off) == 1 else 'are'} not enabled: the machine may not suspend, or not "
            "resume",
            f"{m.sudo}systemctl enable {' '.join(off)}",
        )
    else:
        yield ok("suspend.kept", "GPU memory is saved at a suspend (nvidia-suspend.service)")


def _version(loaded: str | None) -> str:
    found = re.search(r"\b\d+\.\d+(\.\d+)?\b", loaded or "")
    return found[0] if found else "of an unknown version"


def _gpu_without_driver(m: Machine) -> str | None:
    """Return the driver that an NVIDIA display device has, "" for none; None: no such device."""
    for name in m.names("/sys/bus/pci/devices"):
        device = f"/sys/bus/pci/devices/{name}"
        vendor, kind = m.text(f"{device}/vendor") or "", m.text(f"{device}/class") or ""
        if vendor.strip() == NVIDIA and kind.startswith("0x03"):
            bound = m.path(f"{device}/driver")
            return os.path.basename(os.readlink(bound)) if bound.is_symlink() else ""
    return None


def _is_masked(m: Machine, unit: str) -> bool:
    place = m.path(f"/etc/systemd/system/{unit}")
    return place.is_symlink() and os.readlink(place) == "/dev/null"


def _sleep_unit_enabled(m: Machine, unit: str) -> bool:
    folders = [name for name in m.names("/etc/systemd/system") if name.startswith("systemd-")]
    return any(m.exists(f"/etc/systemd/system/{folder}/{unit}") for folder in folders)
