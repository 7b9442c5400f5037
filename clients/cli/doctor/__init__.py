"""`vramctl doctor`: examines installation, machine and arbiter, and changes nothing."""

import argparse
import json
import os
import sys
from collections import Counter
from pathlib import Path
from typing import Final

import vram_arbiter
from vram_arbiter.clients.cli import arguments, terminal
from vram_arbiter.clients.cli.doctor import (
    access,
    cgroup,
    driver,
    health,
    installation,
    leftovers,
)
from vram_arbiter.clients.cli.doctor.findings import WRONG, Checks, Report, Severity, examine
from vram_arbiter.clients.cli.doctor.machine import (
    Machine,
    ask_nvml,
    this_installation,
    this_machine,
)
from vram_arbiter.clients.cli.replies import NO, OK, UNREACHABLE
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.runtime.version import version

DESCRIPTIONS = {
    "doctor": "Examine installation, driver, socket, permissions, cgroups, suspend, "
    "leftovers, a second arbiter, units, and what the arbiter says of itself and its GPUs. Each "
    "finding names a command that resolves it; nothing is changed. Exits 0 without a warning or "
    "error, 1 with one, 3 if the arbiter cannot be reached."
}

CHECKS: Final[Checks[Machine]] = (
    ("installation", installation.origins, ""),
    ("driver", driver.driver, ""),
    ("devices", driver.devices, "the device nodes may be opened"),
    ("suspend", driver.suspend, "no suspend loses GPU memory"),
    ("socket", access.socket, "an arbiter answers"),
    ("permissions", access.permissions, "the socket is open to its group alone"),
    ("operators", access.operators, "this user may evict, pin and drain"),
    ("versions", installation.versions, "client and daemon are of one version"),
    ("daemon", health.daemon, ""),
    ("probe", health.probe, ""),
    ("stowaways", health.stowaways, "every GPU process has a lease"),
    ("orphans", leftovers.sockets, "every socket beside the arbiter's is served"),
    ("cgroup", cgroup.memory, "no memory limit affects the daemon"),
    ("oom", cgroup.out_of_memory, "the daemon is not the first to be killed"),
    ("ports", leftovers.arbiters, "no second arbiter of real GPUs"),
    ("units", installation.units, "the unit is enabled, and its program exists"),
)
"""First part of the findings' codes, check, and what is said where it finds nothing; in the order
of the report."""

_WIDTH: Final = 22


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    return doctor(as_json=args.as_json, endpoint=args.endpoint)


def doctor(*, as_json: bool, endpoint: str | None) -> int:
    """Examine this machine and print the report. Return the exit code."""
    where = endpoint or arbiter_endpoint(os.environ, os.getuid())
    installed = this_installation(str(Path(vram_arbiter.__file__).parent), version())
    machine = this_machine(where, ask_nvml(), installed)
    report = Report(where, examine(machine, CHECKS))
    if as_json:
        print(json.dumps(to_map(report), indent=2))
    else:
        width = terminal.columns()
        print("\n".join(lines_of(report, color=sys.stdout.isatty(), width=width)))
    if machine.arbiter.problem is not None:
        return UNREACHABLE
    return NO if any(one.severity in WRONG for one in report.findings) else OK


def lines_of(report: Report, *, color: bool = False, width: int | None = None) -> list[str]:
    """Return the report as lines: severity, code, what was found; below it what fixes it.

    `width`: columns to which findings are folded; commands stay in one line.
    """
    lines, indent = [printable(f"examined for {report.endpoint}")], 9 + _WIDTH + 1
    for one in report.findings:
        mark = f"{one.severity.upper() if one.severity in WRONG else one.severity:<8}"
        line = f"{mark} {one.code:<{_WIDTH}} {printable(one.found)}"
        first, *more = terminal.folded(line, indent, width)
        if color:
            first = first.replace(mark, f"\x1b[{_COLORS[one.severity]}m{mark}\x1b[0m", 1)
        lines += [first, *more]
        if one.fix and one.severity is not Severity.OK:
            lines.append(f"{'':<{9 + _WIDTH}} → {printable(one.fix)}")
    counts = Counter(one.severity for one in report.findings)
    said = ", ".join(f"{counts[one]} {one}" for one in Severity if counts[one])
    return [*lines, said]


_COLORS: Final = {
    Severity.OK: "32",
    Severity.NOTE: "36",
    Severity.UNKNOWN: "35",
    Severity.WARNING: "33",
    Severity.ERROR: "31",
}
