"""Attribution of bytes in a process *tree*: a child's bytes are charged to the ancestor that holds
the lease, and those of a unit or a container to the holder of the lease that names its cgroup.

In two halves: `Lineages` reads ancestors and cgroups from /proc and may block (a probe's thread);
`on_owners` attributes by the holders of that very moment (the loop's thread). Must not decide
anything about leases: it only says which process a reading's bytes belong to.
"""

from collections.abc import Callable, Iterable, Mapping, Sequence, Set
from dataclasses import dataclass, replace

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs

DEPTH_MAX = 64
"""Ancestors looked at; deeper trees are broken or hostile."""
NAME_MAX = 128


@dataclass(frozen=True, slots=True)
class Kin:
    """One process as /proc shows it."""

    process: ProcessKey
    parent_pid: int
    name: str


Reader = Callable[[int], Kin | None]
type Claims = Mapping[str, tuple[ProcessKey, str]]
"""Holder and consumer by the cgroup that the lease names."""


@dataclass(frozen=True, slots=True)
class Lineage:
    """A process's ancestors, its parent first, and its cgroup."""

    ancestors: tuple[Kin, ...]
    cgroup: str


def read_kin(pid: int) -> Kin | None:
    """Return a process and its parent; None if it has ended or cannot be seen from here."""
    stat = procfs.read_stat(pid)
    if stat is None:
        return None
    return Kin(ProcessKey(pid, stat.start_ticks), stat.parent_pid, stat.name)


class Lineages:
    """Lineages of the processes of one GPU's readings. Remembers the last reading's, for a
    process that dies before it is traced."""

    def __init__(
        self, read: Reader = read_kin, read_cgroup: Callable[[int], str] = procfs.read_cgroup
    ) -> None:
        self._read, self._read_cgroup = read, read_cgroup
        self._last: dict[int, tuple[ProcessKey, Lineage]] = {}

    def trace(self, processes: Iterable[ProcessUse]) -> dict[ProcessKey, Lineage]:
        """Lineages of those that are, or just were, visible."""
        before, self._last = self._last, {}
        found: dict[ProcessKey, Lineage] = {}
        for use in processes:
            process, lineage = use.process, self._lineage(use.process)
            # a process that is gone is found by its pid alone
            if lineage is None and use.process.pid in before:
                process, lineage = before[use.process.pid]
                if use.process.start_ticks not in (0, process.start_ticks):
                    lineage = None
            if lineage is not None:
                found[use.process] = lineage
                self._last[process.pid] = (process, lineage)
        return found

    def _lineage(self, process: ProcessKey) -> Lineage | None:
        """None if that process is gone. A parent that is younger than its child is another process
        with a reused pid: the line ends."""
        cgroup = self._read_cgroup(process.pid)
        kin = self._read(process.pid)  # afterwards: the cgroup was that of this very process
        if kin is None or kin.process != process:
            return None
        line: list[Kin] = []
        while kin.parent_pid > 0 and len(line) < DEPTH_MAX:
            parent = self._read(kin.parent_pid)
            if parent is None or parent.process.start_ticks > kin.process.start_ticks:
                break
            line.append(parent)
            kin = parent
        return Lineage(tuple(line), cgroup)


def on_owners(
    processes: Sequence[ProcessUse],
    lineages: Mapping[ProcessKey, Lineage],
    owners: Set[ProcessKey],
    clients: Set[ProcessKey],
    claims: Claims,
) -> tuple[ProcessUse, ...]:
    """The reading's processes with the bytes of children booked on their owner: the nearest
    ancestor that has an account, else the holder of the lease that names their cgroup.

    A process with an account (`owners`) or a connection (`clients`) keeps its own bytes; one
    without an owner stays a stowaway. A start time of 0 matches any process with that pid.
    Bytes that the driver does not say (None) make the sum unknown.
    """
    pids = {known.pid for some in (owners, clients) for known in some}
    booked: dict[ProcessKey, ProcessUse] = {}
    children: dict[ProcessKey, list[str]] = {}
    for use in processes:
        process, target = use.process, use
        has_own = process in owners or process in clients
        if not has_own and not (process.start_ticks == 0 and process.pid in pids):
            lineage = lineages.get(process)
            owner = None if lineage is None else _owner(lineage, owners, claims)
            if owner is not None:
                target = ProcessUse(*owner, use.used_bytes)
                names = children.setdefault(target.process, [])
                if use.name and use.name not in names:  # a dying one has no name any more
                    names.append(use.name)
        if (there := booked.get(target.process)) is not None:
            # what the probe calls the owner says more
            name = use.name if target is use else there.name
            both_known = there.used_bytes is not None and use.used_bytes is not None
            total = (there.used_bytes or 0) + (use.used_bytes or 0) if both_known else None
            target = ProcessUse(target.process, name, total)
        booked[target.process] = target
    for process, names in children.items():
        if names:  # `vramctl (python)`: the owner, and the child that is charged to it
            named = f"{booked[process].name} ({', '.join(names)})"[:NAME_MAX]
            booked[process] = replace(booked[process], name=named)
    return tuple(booked.values())


def _owner(
    lineage: Lineage, owners: Set[ProcessKey], claims: Claims
) -> tuple[ProcessKey, str] | None:
    """Return the process that a lineage's bytes are booked on, with its name; None: there is
    none. The deepest of the cgroups that are named wins."""
    for kin in lineage.ancestors:
        if kin.process in owners:
            return kin.process, kin.name
    cgroup = lineage.cgroup
    while cgroup:
        if cgroup in claims:
            return claims[cgroup]
        cgroup = cgroup.rpartition("/")[0]
    return None
