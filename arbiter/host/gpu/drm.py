"""Reader of AMD GPUs (driver `amdgpu`) and Intel's (`xe`) by what the kernel tells of them: no
library, no context.

Totals are the driver's own. Bytes per process are in the fdinfo of each file of a GPU that a
process has open (kernel, Documentation/gpu/drm-usage-stats.rst). Those are shown to the process's
user and to CAP_SYS_PTRACE: with a gap in the list a process's bytes would have no owner, so the
list is unknown unless every process can be looked at.
"""

import ctypes
import fcntl
import os
import re
import struct
from collections.abc import Callable, Iterator
from pathlib import Path

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.gpu.pids import PidMap
from vram_arbiter.arbiter.host.gpu.probe import GpuDevice, Reading
from vram_arbiter.schemas.defaults import KIB, MIB
from vram_arbiter.schemas.errors import NoGpu, ProbeFailed, UnknownGpu
from vram_arbiter.schemas.ids import GpuId
from vram_arbiter.schemas.wire.views import SensorsView

CARDS = "sys/class/drm"
NODES = "dev/dri"
XE_QUERY = 0xC0286440
"""DRM_IOCTL_XE_DEVICE_QUERY with struct drm_xe_device_query (include/uapi/drm/xe_drm.h)."""
XE_REGIONS, XE_VRAM = 1, 1
"""DRM_XE_DEVICE_QUERY_MEM_REGIONS and DRM_XE_MEM_REGION_CLASS_VRAM."""
_QUESTION = struct.Struct("=QIIQ16x")  # extensions, query, size of the answer, its address
_REGION = struct.Struct("=HHIQQ64x")  # class, instance, page size, total, used
_UNITS = {"": 1, "KiB": KIB, "MiB": MIB}


class DrmProbe:
    """`GpuProbe` over the GPUs of these drivers that have memory, in the order of the PCI bus.

    A GPU's id is `AMD-` with the number of its chip, which ROCm's UUID has behind `GPU-`; `PCI-`
    with its place for one without a number. `root` is where /sys and /dev are looked for. Raises
    NoGpu or ProbeFailed.
    """

    def __init__(self, pids: PidMap, root: Path = Path("/")) -> None:
        self._pids = pids
        self._root = root
        cards = [card for card in (root / CARDS).glob("card*/device") if _driver(card) in _MEMORY]
        found = [card for card in sorted(cards, key=_place) if self._memory(card)[1]]
        self._folders = {_id(card): card for card in found}
        if not found:
            raise NoGpu(
                f"no GPU of the drivers {' and '.join(_MEMORY)} has memory of its own",
                hint="see lspci -k, or start with --gpu fake:8GiB to simulate a GPU",
            )

    def gpus(self) -> tuple[GpuDevice, ...]:
        found = []
        for index, (gpu, folder) in enumerate(self._folders.items()):
            name = _text(folder / "product_name") or f"{_driver(folder)} {_place(folder)}"
            found.append(GpuDevice(gpu, index, name, self._memory(folder)[1]))
        return tuple(found)

    def sample(self, gpu: GpuId) -> Reading:
        folder = self._folders.get(gpu)
        if folder is None:
            raise UnknownGpu(f"no GPU {gpu}", details={"known": sorted(self._folders)})
        used, total = self._memory(folder)
        return Reading(used, total, self._processes(_place(folder)))

    def sensors(self, gpu: GpuId) -> SensorsView:
        """By hwmon, in millidegrees and microwatts; of several temperatures the first."""
        folder = self._folders[gpu]
        return SensorsView(
            _first(folder, 100, "gpu_busy_percent"),
            _first(folder, 1e3, "hwmon/hwmon*/temp*_input"),
            _first(folder, 1e6, "hwmon/hwmon*/power1_average", "hwmon/hwmon*/power1_input"),
        )

    def close(self) -> None:
        """Nothing is held open."""

    def _memory(self, folder: Path) -> tuple[int, int]:
        """(used, total) in bytes. Raises ProbeFailed."""
        try:
            return _MEMORY[_driver(folder)](folder, self._root)
        except (OSError, ValueError, KeyError, struct.error) as error:
            problem = f"memory of {_place(folder)} cannot be read: {error}"
            raise ProbeFailed(problem, hint="see dmesg") from error

    def _processes(self, place: str) -> tuple[ProcessUse, ...] | None:
        """Return the processes that have the GPU open. A client of the driver that several of them
        share counts once, for the first one."""
        if not self._pids.knows:
            return None
        proc, clients, found = self._pids.listed_in, set[str | None](), list[ProcessUse]()
        pids = _pids(proc)
        if 1 not in pids:
            return None  # mounted so that processes of other users are hidden
        for pid in pids:
            try:
                told = [one for one in _clients(proc / str(pid)) if one.get("drm-pdev") == place]
            except (FileNotFoundError, ProcessLookupError):
                continue  # it ended meanwhile
            except OSError:
                return None
            own = {one.get("drm-client-id"): one for one in told}
            if new := own.keys() - clients:
                clients |= new
                used = [_resident(own[client]) for client in new]
                all_told = None if None in used else sum(size or 0 for size in used)
                found.append(ProcessUse(*self._pids.translate(pid), all_told))
        return tuple(found)


# -- memory of a GPU: (used, total) in bytes
def amd_memory(folder: Path, _: Path) -> tuple[int, int]:
    """What `amdgpu` shows in the folder of its PCI device."""
    used, total = (int((folder / f"mem_info_vram_{one}").read_text()) for one in ("used", "total"))
    return used, total


def xe_memory(folder: Path, root: Path) -> tuple[int, int]:
    """What `xe` answers at its render node. Without CAP_PERFMON it calls no byte used."""
    (name,) = (node.name for node in folder.glob("drm/renderD*"))
    node = root / NODES / name
    with node.open("r+b", buffering=0) as file:
        asked = bytearray(_QUESTION.pack(0, XE_REGIONS, 0, 0))
        fcntl.ioctl(file, XE_QUERY, asked)
        size = _QUESTION.unpack(asked)[2]
        answer = ctypes.create_string_buffer(size)
        asked = bytearray(_QUESTION.pack(0, XE_REGIONS, size, ctypes.addressof(answer)))
        fcntl.ioctl(file, XE_QUERY, asked)
    (count,) = struct.unpack_from("=I", answer)
    regions = [_REGION.unpack_from(answer, 8 + at * _REGION.size) for at in range(count)]
    used, total = (sum(one[at] for one in regions if one[0] == XE_VRAM) for at in (4, 3))
    if total and not used:  # the driver itself uses some; an integrated GPU has no memory
        raise PermissionError(f"{node} hides what is used; the arbiter needs CAP_PERFMON")
    return used, total


_MEMORY: dict[str, Callable[[Path, Path], tuple[int, int]]] = {
    "amdgpu": amd_memory,
    "xe": xe_memory,
}
"""By driver. An AMD APU's video memory is only the part that the firmware set aside."""


# -- processes
def _pids(proc: Path) -> list[int]:
    try:
        return sorted(int(name) for name in os.listdir(proc) if name.isdecimal())
    except OSError:
        return []


def _clients(process: Path) -> Iterator[dict[str, str]]:
    """Yield what a process's files of GPUs tell. Raises OSError where it may not be looked at."""
    for name in os.listdir(process / "fd"):
        try:
            if not os.readlink(process / "fd" / name).startswith(f"/{NODES}/"):
                continue
            lines = (process / "fdinfo" / name).read_text(errors="replace").splitlines()
        except FileNotFoundError:
            continue  # closed meanwhile
        keys = (line.partition(":") for line in lines if line.startswith("drm-"))
        yield {key: value.strip() for key, _, value in keys}


def _resident(client: dict[str, str]) -> int | None:
    """Return a client's bytes in video memory; None: the driver does not tell."""
    told = [value for key, value in client.items() if re.fullmatch(r"drm-resident-vram\d*", key)]
    told = told or [client.get("drm-memory-vram", "")]  # its older name
    sizes = [re.fullmatch(r"(\d+) ?([KM]iB|)", value) for value in told]
    return None if None in sizes else sum(int(one[1]) * _UNITS[one[2]] for one in sizes if one)


# -- files of a PCI device
def _uevent(folder: Path, key: str) -> str:
    found = re.search(rf"^{key}=(\S+)$", _text(folder / "uevent"), re.MULTILINE)
    return found[1] if found else ""


def _driver(folder: Path) -> str:
    return _uevent(folder, "DRIVER")


def _place(folder: Path) -> str:
    """Return the PCI address, as `drm-pdev` has it."""
    return _uevent(folder, "PCI_SLOT_NAME")


def _id(folder: Path) -> GpuId:
    chip = _text(folder / "unique_id")
    return GpuId(f"AMD-{chip}" if chip else f"PCI-{_place(folder)}")


def _first(folder: Path, units: float, *patterns: str) -> float | None:
    """Return the first number in such files, of which so many are one; None: there is none."""
    texts = (_text(path) for pattern in patterns for path in sorted(folder.glob(pattern)))
    return next((int(text) / units for text in texts if text.isdecimal()), None)


def _text(path: Path) -> str:
    try:
        return path.read_text(errors="replace").strip()
    except OSError:
        return ""
