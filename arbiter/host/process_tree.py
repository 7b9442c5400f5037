"""Attribution of bytes in a process *tree*: a child's bytes are charged to the ancestor that holds
the lease.

In two halves: `Lineages` reads ancestors from /proc and may block (a probe's thread); `on_owners`
attributes by the holders of that very moment (the loop's thread). Must not decide anything about
leases: it only says which process a reading's bytes belong to.
"""

from collections.abc import Callable, Iterable, Mapping, Set
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
Lineage = tuple[Kin, ...]
"""A process's ancestors, its parent first."""


@dataclass(frozen=True, slots=True)
class Known:
    """Processes that the arbiter knows: with an account on the GPU, and with a connection."""

    owners: Set[ProcessKey]
    clients: Set[ProcessKey]

    def independent(self, process: ProcessKey) -> bool:
        """Whether a process keeps its own bytes. Start time 0 matches any process with that pid."""
        if process in self.owners or process in self.clients:
            return True
        return process.start_ticks == 0 and any(
            known.pid == process.pid for some in (self.owners, self.clients) for known in some
        )


def read_kin(pid: int) -> Kin | None:
    """Return a process and its parent; None if it has ended or cannot be seen from here."""
    stat = procfs.read_stat(pid)
    if stat is None:
        return None
    return Kin(ProcessKey(pid, stat.start_ticks), stat.parent_pid, stat.name)


class Lineages:
    """Ancestors of the processes of one card's readings. Remembers the last reading's, for a
    process that dies before it is traced."""

    def __init__(self, read: Reader = read_kin) -> None:
        self._read = read
        self._last: dict[int, tuple[ProcessKey, Lineage]] = {}

    def trace(self, processes: Iterable[ProcessUse]) -> dict[ProcessKey, Lineage]:
        """Lineages of those that are, or just were, visible."""
        before, self._last = self._last, {}
        found: dict[ProcessKey, Lineage] = {}
        for use in processes:
            process, lineage = use.process, self._ancestors(use.process)
            if (
                lineage is None and use.process.pid in before
            ):  # it is gone; so may be its start time
                process, lineage = before[use.process.pid]
                if use.process.start_ticks not in (0, process.start_ticks):
                    lineage = None
            if lineage is not None:
                found[use.process] = lineage
                self._last[process.pid] = (process, lineage)
        return found

    def _ancestors(self, process: ProcessKey) -> Lineage | None:
        """None if that process is gone. A parent that is younger than its child is another process
        with a reused pid: the line ends."""
        kin = self._read(process.pid)
        if kin is None or kin.process != process:
            return None
        line: list[Kin] = []
        while kin.parent_pid > 0 and len(line) < DEPTH_MAX:
            parent = self._read(kin.parent_pid)
            if parent is None or parent.process.start_ticks > kin.process.start_ticks:
                break
            line.append(parent)
            kin = parent
        return tuple(line)


def on_owners(
    processes: Iterable[ProcessUse], lineages: Mapping[ProcessKey, Lineage], known: Known
) -> tuple[ProcessUse, ...]:
    """The reading's processes with the bytes of children booked on their nearest ancestor that has
    an account.

    A process with an account or a connection of its own keeps its own bytes; one without such an
    ancestor stays a stowaway. Bytes that the driver does not say (None) make the sum unknown.
    """
    booked: dict[ProcessKey, ProcessUse] = {}
    children: dict[ProcessKey, list[str]] = {}
    for use in processes:
        owner = None
        if not known.independent(use.process):
            owner = next(
                (kin for kin in lineages.get(use.process, ()) if kin.process in known.owners), None
            )
        target = use if owner is None else ProcessUse(owner.process, owner.name, use.used_bytes)
        if owner is not None:
            names = children.setdefault(owner.process, [])
            if use.name and use.name not in names:  # a dying one has no name any more
                names.append(use.name)
        there = booked.get(target.process)
        if there is None:
            booked[target.process] = target
            continue
        name = use.name if owner is None else there.name  # what the probe calls the owner says more
        both_known = there.used_bytes is not None and use.used_bytes is not None
        total = (there.used_bytes or 0) + (use.used_bytes or 0) if both_known else None
        booked[target.process] = ProcessUse(target.process, name, total)
    return tuple(_named(use, children.get(use.process, [])) for use in booked.values())


def _named(use: ProcessUse, children: list[str]) -> ProcessUse:
    """Return `vramctl (python)`: the owner, and the child that is charged to it."""
    if not children:
        return use
    return replace(use, name=f"{use.name} ({', '.join(children)})"[:NAME_MAX])
