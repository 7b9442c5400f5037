"""Checks of the clocks that leases, history and traces rely on."""

from collections.abc import Iterator
from datetime import UTC, datetime
from itertools import pairwise
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, note, warning
from vram_arbiter.clients.cli.doctor.machine import Machine
from vram_arbiter.clients.cli.text import duration

JUMP_S: Final = 1.0
"""A clock that is slewed never goes back by so much."""
PLAUSIBLE_S: Final = datetime(2025, 1, 1, tzinfo=UTC).timestamp()
SLEPT_S: Final = 1.0


def wall(m: Machine) -> Iterator[Finding]:
    """The wall clock is set and did not jump: the history's times can be believed."""
    fix = f"{m.sudo}timedatectl set-ntp true"
    if m.clocks.wall < PLAUSIBLE_S:
        at = datetime.fromtimestamp(m.clocks.wall, UTC).date()
        yield warning("clocks.unset", f"the wall clock says {at}: it was never set", fix)
        return
    if m.arbiter.status is None:
        raise CouldNotLook("jumps of the wall clock show in the history, and no arbiter answers")
    now = {"seq": "the present", "at_wall_s": m.clocks.wall}
    for before, after in pairwise([*m.arbiter.history, now]):
        back = before["at_wall_s"] - after["at_wall_s"]
        if back > JUMP_S:
            yield warning(
                "clocks.jumped",
                f"the wall clock went back by {duration(back)} between the events {before['seq']} "
                f"and {after['seq']}: times of the history before that are wrong",
                fix,
            )


def monotonic(m: Machine) -> Iterator[Finding]:
    """Programs and daemon count the same seconds."""
    offsets = (m.text("/proc/self/timens_offsets") or "").splitlines()
    moved = [line.split()[0] for line in offsets if set(line.split()[1:]) - {"0", "-0"}]
    if moved:
        yield warning(
            "clocks.namespace",
            f"a time namespace moves {' and '.join(moved)} here: start times of processes do not "
            "match those that the daemon sees",
            "unshare --time --monotonic 0 --boottime 0 vramctl doctor",
        )
        return
    slept = m.clocks.boottime - m.clocks.monotonic
    if slept > SLEPT_S:
        what = f"the machine slept for {duration(slept)} since its start; no TTL ran meanwhile"
        yield note("clocks.slept", what, "vramctl history --kind resumed")
