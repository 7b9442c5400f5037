"""Checks of the clocks that leases, history and traces rely on."""

from collections.abc import Iterator
from datetime import UTC, datetime
from typing import Final

from vram_arbiter.clients.cli.doctor.findings import CouldNotLook, Finding, note, ok, warning
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
    before, jumps = None, []
    for event in m.arbiter.history:
        if before is not None and event["at_wall_s"] < before["at_wall_s"] - JUMP_S:
            jumps.append((before, event))
        before = event
    if jumps:
        before, after = jumps[-1]
        back = before["at_wall_s"] - after["at_wall_s"]
        yield warning(
            "clocks.jumped",
            f"the wall clock went back by {duration(back)} between the events {before['seq']} and "
            f"{after['seq']}: times of the history before that are wrong",
            fix,
        )
    elif before is not None and before["at_wall_s"] > m.clocks.wall + JUMP_S:
        ahead = before["at_wall_s"] - m.clocks.wall
        yield warning(
            "clocks.jumped",
            f"the newest event is {duration(ahead)} in the future: the wall clock went back",
            fix,
        )
    else:
        yield ok("clocks.wall", f"no jump of the wall clock in {len(m.arbiter.history)} events")


def monotonic(m: Machine) -> Iterator[Finding]:
    """Programs and daemon count the same seconds."""
    offsets = m.text("/proc/self/timens_offsets") or ""
    moved = [line.split()[0] for line in offsets.splitlines() if any(_nonzero(line))]
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
        yield note(
            "clocks.slept",
            f"the machine slept for {duration(slept)} since it was started; no TTL ran meanwhile",
            "vramctl history --kind resumed",
        )
    else:
        yield ok("clocks.monotonic", "boottime and monotonic agree: no suspend since the start")


def _nonzero(line: str) -> list[bool]:
    return [word.lstrip("-") != "0" for word in line.split()[1:]]
