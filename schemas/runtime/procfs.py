"""What /proc says of processes and of the machine's boot. Reads only; blocks for microseconds."""

from dataclasses import dataclass
from pathlib import Path

PROC = Path("/proc")
_DEAD = b"ZXx"
"""States of a process whose memory the kernel has taken already (proc_pid_stat(5))."""


@dataclass(frozen=True, slots=True)
class Stat:
    """Fields of /proc/PID/stat."""

    name: str
    alive: bool
    parent_pid: int
    start_ticks: int
    """Clock ticks from boot to the process's start; with the pid it names a process for good."""


def parse_stat(stat: bytes) -> Stat:
    """Return the fields of one line of /proc/PID/stat.

    The name may hold spaces and parentheses, and is cut after 15 bytes, perhaps inside a character.
    Raises ValueError or IndexError for what is not such a line.
    """
    name, _, rest = stat.partition(b"(")[2].rpartition(b")")
    fields = rest.split()
    return Stat(
        name=name.decode(errors="replace"),
        alive=fields[0] not in _DEAD,
        parent_pid=int(fields[1]),
        start_ticks=int(fields[19]),
    )


def read_stat(pid: int, proc: Path = PROC) -> Stat | None:
    """Return the stat of a process; None if it has ended or cannot be seen from here."""
    try:
        return parse_stat((proc / str(pid) / "stat").read_bytes())
    except (OSError, IndexError, ValueError):
        return None


def read_cgroup(pid: int, proc: Path = PROC) -> str:
    """Return a process's cgroup of the v2 hierarchy; "" if it has ended, or there is none."""
    try:
        lines = (proc / str(pid) / "cgroup").read_text(errors="replace").splitlines()
    except OSError:
        return ""
    return next((line[3:] for line in lines if line.startswith("0::")), "")


def cgroup_root(proc: Path = PROC) -> Path | None:
    """Return where the root of the cgroup v2 hierarchy is mounted, as this process sees it."""
    for line in (proc / "self/mountinfo").read_text().splitlines():
        mount, _, source = line.partition(" - ")  # proc_pid_mountinfo(5)
        root, place = mount.split()[3:5]
        if source.startswith("cgroup2 ") and root == "/":
            return Path(place)
    return None


def start_ticks(pid: int) -> int | None:
    """Return the start time of a process, a zombie too; None if there is no such process."""
    stat = read_stat(pid)
    return None if stat is None else stat.start_ticks


def boot_id() -> str:
    """Return the id of this boot: it changes with every boot of the machine, and only then."""
    return (PROC / "sys/kernel/random/boot_id").read_text().strip()
