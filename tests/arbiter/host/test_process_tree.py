"""Bytes of children on the ancestor that holds the lease; /proc is a dict here, except where its
real text is read."""

import os
import subprocess
import sys
from collections.abc import Mapping, Set
from pathlib import Path

import pytest

from vram_arbiter.arbiter.core.events import ProcessUse
from vram_arbiter.arbiter.host.process_tree import (
    DEPTH_MAX,
    NAME_MAX,
    Claims,
    Kin,
    Lineages,
    on_owners,
    read_kin,
)
from vram_arbiter.schemas.ids import ProcessKey
from vram_arbiter.schemas.runtime import procfs


def key(pid: int) -> ProcessKey:
    """In these tests a process started at ten times its pid."""
    return ProcessKey(pid, 10 * pid)


def use(pid: int, count: int | None, name: str = "python") -> ProcessUse:
    return ProcessUse(key(pid), name, count)


Known = tuple[Set[ProcessKey], Set[ProcessKey], Claims]


def known(
    owners: tuple[int, ...] = (),
    clients: tuple[int, ...] = (),
    claims: Mapping[str, int] | None = None,
) -> Known:
    named = {cgroup: (key(pid), f"of {pid}") for cgroup, pid in (claims or {}).items()}
    return frozenset(map(key, owners)), frozenset(map(key, clients)), named


class Proc:
    """`/proc` as a dict: pid → (parent's pid, name). 1 init, 20 shell, 30 vramctl, 40 program, 50
    its worker."""

    def __init__(self) -> None:
        self.kin = {1: Kin(key(1), 0, "init")}
        for pid, parent, name in (
            (20, 1, "bash"),
            (30, 20, "vramctl"),
            (40, 30, "sh"),
            (50, 40, "python"),
        ):
            self.add(pid, parent, name)
        self.cgroups: dict[int, str] = {}

    def add(self, pid: int, parent: int, name: str, start_ticks: int | None = None) -> None:
        self.kin[pid] = Kin(
            ProcessKey(pid, 10 * pid if start_ticks is None else start_ticks), parent, name
        )

    def book(self, who: Known, *uses: ProcessUse) -> tuple[ProcessUse, ...]:
        return on_owners(uses, self.lineages().trace(uses), *who)

    def lineages(self) -> Lineages:
        return Lineages(self.kin.get, lambda pid: self.cgroups.get(pid, ""))


def test_a_child_s_bytes_are_its_owner_s_at_any_depth() -> None:
    proc = Proc()
    assert proc.book(known((30,)), use(40, 3)) == (use(30, 3, "vramctl (python)"),)
    assert proc.book(known((30,)), use(50, 5)) == (use(30, 5, "vramctl (python)"),)


def test_the_nearest_owner_gets_them() -> None:
    assert Proc().book(known((20, 30)), use(50, 5)) == (use(30, 5, "vramctl (python)"),)


def test_entries_of_one_owner_are_summed_and_named_whatever_their_order() -> None:
    proc = Proc()
    proc.add(60, 30, "worker")
    own, child, worker = use(30, 1, "vramctl run"), use(40, 2, "sh"), use(60, 4, "worker")
    assert proc.book(known((30,)), own, child, worker) == (use(30, 7, "vramctl run (sh, worker)"),)
    assert proc.book(known((30,)), child, own, worker, use(50, 8, "sh")) == (
        use(30, 15, "vramctl run (sh, worker)"),
    )


def test_a_child_without_a_name_adds_none() -> None:
    assert Proc().book(known((30,)), use(40, 2, "")) == (use(30, 2, "vramctl"),)


def test_bytes_that_the_driver_does_not_say_make_the_sum_unknown() -> None:
    assert Proc().book(known((30,)), use(40, 2), use(50, None)) == (
        use(30, None, "vramctl (python)"),
    )


def test_a_child_with_a_lease_or_a_connection_of_its_own_keeps_its_bytes() -> None:
    proc = Proc()
    for who in (known((30, 40)), known((30,), (40,))):
        assert proc.book(who, use(40, 3)) == (use(40, 3),)
    assert proc.book(known((30,), (40,)), use(40, 3), use(50, 4)) == (
        use(40, 3),
        use(30, 4, "vramctl (python)"),
    )


def test_a_dying_owner_that_is_listed_without_its_start_time_keeps_its_bytes() -> None:
    proc = Proc()
    lineages = proc.lineages()
    lineages.trace([use(40, 3)])
    del proc.kin[40]
    left = ProcessUse(ProcessKey(40, 0), "", 3)
    assert on_owners([left], lineages.trace([left]), *known((30, 40))) == (left,)


def test_children_of_a_mere_observer_are_not_hidden() -> None:
    assert Proc().book(known((), (30,)), use(40, 3)) == (use(40, 3),)


def test_a_reused_pid_is_no_ancestor() -> None:
    proc = Proc()
    proc.add(30, 20, "other", start_ticks=9_999)  # younger than its "child": the pid was used again
    owner = ProcessKey(30, 9_999)
    assert proc.book((frozenset({owner}), frozenset(), {}), use(40, 3)) == (use(40, 3),)
    assert proc.book(known((30,)), use(40, 3)) == (use(40, 3),), "and the owner of that pid is dead"


def test_an_orphan_is_a_stowaway() -> None:
    proc = Proc()
    lineages = proc.lineages()
    assert on_owners([use(40, 3)], lineages.trace([use(40, 3)]), *known((30,)))[0].process == key(
        30
    )
    del proc.kin[30]
    proc.add(40, 1, "sh")  # the kernel gave it to init
    assert on_owners([use(40, 3)], lineages.trace([use(40, 3)]), *known((30,))) == (use(40, 3),)


@pytest.mark.parametrize("listed", [key(40), ProcessKey(40, 0)])
def test_who_dies_between_the_reading_and_the_tracing_belongs_where_it_did(
    listed: ProcessKey,
) -> None:
    proc = Proc()
    lineages = proc.lineages()
    lineages.trace([use(40, 3)])
    del proc.kin[40]
    left = ProcessUse(listed, "python", 3)
    for _ in range(2):
        assert on_owners([left], lineages.trace([left]), *known((30,)))[0].process == key(30)
    lineages.trace([])
    assert on_owners([left], lineages.trace([left]), *known((30,))) == (left,), (
        "remembered for one reading"
    )


def test_somebody_else_with_the_pid_of_the_dead_inherits_nothing() -> None:
    proc = Proc()
    lineages = proc.lineages()
    lineages.trace([use(40, 3)])
    del proc.kin[40]
    other = ProcessUse(ProcessKey(40, 77_777), "other", 3)
    assert on_owners([other], lineages.trace([other]), *known((30,))) == (other,)


def test_lines_are_followed_so_far_and_names_are_bounded() -> None:
    proc = Proc()
    for pid in range(100, 100 + DEPTH_MAX + 2):
        proc.add(pid, pid - 1 if pid > 100 else 30, "deep")
    assert proc.book(known((30,)), use(100 + DEPTH_MAX - 1, 3))[0].process == key(30)
    assert proc.book(known((30,)), use(100 + DEPTH_MAX, 3))[0].process == key(100 + DEPTH_MAX)
    uses = [use(100 + n, 1, f"a rather long name {n}") for n in range(10)]
    (booked,) = proc.book(known((30,)), *uses)
    assert (len(booked.name), booked.used_bytes) == (NAME_MAX, 10)


def test_a_driver_that_lists_nobody_leaves_nothing_to_book() -> None:
    assert Proc().book(known((30,))) == ()


# -- units and containers
UNIT = "/system.slice/llm.service"


def in_unit(cgroup: str = UNIT) -> Proc:
    """70: a process that init started, in a unit's cgroup."""
    proc = Proc()
    proc.add(70, 1, "ollama")
    proc.cgroups[70] = cgroup
    return proc


@pytest.mark.parametrize("cgroup", [UNIT, f"{UNIT}/worker", f"{UNIT}/a/b"])
def test_bytes_of_a_cgroup_are_those_of_the_lease_that_names_it(cgroup: str) -> None:
    """The holder may be a waiter that has no account yet: what the unit holds already is its."""
    for owners in ((), (30,)):
        assert in_unit(cgroup).book(known(owners, (30,), {UNIT: 30}), use(70, 5, "python")) == (
            use(30, 5, "of 30 (python)"),
        )


@pytest.mark.parametrize(
    "cgroup", ["", "/", "/system.slice", f"{UNIT}x", f"/..{UNIT}", "/a" + UNIT]
)
def test_another_cgroup_stays_a_stowaway(cgroup: str) -> None:
    assert in_unit(cgroup).book(known((30,), (), {UNIT: 30}), use(70, 5)) == (use(70, 5),)


def test_who_has_an_account_a_connection_or_an_ancestor_with_one_is_not_the_cgroups() -> None:
    claims = {UNIT: 30}
    proc = in_unit()
    assert proc.book(known((30, 70), (), claims), use(70, 5)) == (use(70, 5),)
    assert proc.book(known((30,), (70,), claims), use(70, 5)) == (use(70, 5),)
    proc.add(80, 70, "child")
    proc.cgroups[80] = UNIT
    assert proc.book(known((30, 70), (), claims), use(80, 5)) == (use(70, 5, "ollama (python)"),)


def test_the_deepest_named_cgroup_wins() -> None:
    claims = {"/system.slice": 20, UNIT: 30}
    assert in_unit().book(known((), (), claims), use(70, 5))[0].process == key(30)


def test_bytes_of_a_cgroup_and_of_children_are_one_sum() -> None:
    """In either order: the name is the ancestor's, or the consumer's where that comes first."""
    who = known((30,), (), {UNIT: 30})
    assert in_unit().book(who, use(40, 1, "sh"), use(70, 5)) == (
        use(30, 6, "vramctl (sh, python)"),
    )
    assert in_unit().book(who, use(70, 5), use(40, 1, "sh")) == (use(30, 6, "of 30 (python, sh)"),)


def test_one_that_dies_before_it_is_traced_is_still_the_cgroups() -> None:
    proc = in_unit()
    lineages = proc.lineages()
    lineages.trace([use(70, 5)])
    del proc.kin[70], proc.cgroups[70]
    left = ProcessUse(ProcessKey(70, 0), "", 5)
    (booked,) = on_owners([left], lineages.trace([left]), *known((), (), {UNIT: 30}))
    assert booked == use(30, 5, "of 30")


def test_the_cgroup_of_the_second_hierarchy_is_read(tmp_path: Path) -> None:
    own = tmp_path / "5"
    own.mkdir()
    (own / "cgroup").write_text("9:name=systemd:/old\n4:memory:/a:b\n0::/new/a:b\n")
    assert procfs.read_cgroup(5, tmp_path) == "/new/a:b"
    (own / "cgroup").write_text("4:memory:/a\n")
    assert procfs.read_cgroup(5, tmp_path) == ""
    assert procfs.read_cgroup(6, tmp_path) == ""
    (tmp_path / "self").mkdir()
    (tmp_path / "self/mountinfo").write_text(
        "30 25 0:27 / /sys/fs/cgroup/cpu rw - cgroup cgroup rw,cpu\n"
        "31 25 0:28 /below /mnt rw - cgroup2 cgroup2 rw\n"
        "32 25 0:28 / /sys/fs/cgroup/unified rw,nosuid shared:9 - cgroup2 cgroup2 rw\n"
    )
    assert procfs.cgroup_root(tmp_path) == Path("/sys/fs/cgroup/unified")
    (tmp_path / "self/mountinfo").write_text("")
    assert procfs.cgroup_root(tmp_path) is None


def test_the_kernel_s_own_text() -> None:
    mine = read_kin(os.getpid())
    assert (mine.process.pid, mine.parent_pid) == (os.getpid(), os.getppid())
    with subprocess.Popen([sys.executable, "-c", "input()"], stdin=subprocess.PIPE) as child:
        kin = read_kin(child.pid)
        entry = ProcessUse(kin.process, "child", 1)
        (booked,) = on_owners(
            [entry], Lineages().trace([entry]), frozenset({mine.process}), frozenset(), {}
        )
        assert booked == ProcessUse(mine.process, f"{mine.name} (child)", 1)
        child.communicate(b"\n")
    assert read_kin(child.pid) is None
