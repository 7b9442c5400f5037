"""`vramctl doctor`: examines installation, machine and arbiter, and changes nothing."""

import argparse
import json
import os
from collections import Counter
from typing import Final

from vram_arbiter.clients.cli import arguments, terminal
from vram_arbiter.clients.cli.doctor import (
    access,
    driver,
    health,
    installation,
)
from vram_arbiter.clients.cli.doctor.findings import WRONG, Checks, Report, Severity, examine
from vram_arbiter.clients.cli.doctor.machine import Machine, ask_nvml, this_machine
from vram_arbiter.clients.cli.replies import NO, OK, UNREACHABLE
from vram_arbiter.schemas.codec import to_map
from vram_arbiter.schemas.runtime.endpoints import arbiter_endpoint
from vram_arbiter.schemas.runtime.printable import printable

DESCRIPTIONS = {
    "doctor": "Examine driver, suspend, socket, permissions, versions, units, and what the arbiter "
    "says of itself and its GPUs. Each finding names a command that resolves it; nothing is "
    "changed. Exits 0 without a warning or error, 1 with one, 3 if the arbiter cannot be reached."
}

CHECKS: Final[Checks[Machine]] = (
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
    ("oom", health.out_of_memory, "the daemon is not the first to be killed"),
    ("units", installation.units, "the unit is enabled, and its program exists"),
)
"""First part of the findings' codes, check, and what is said where it finds nothing; in the order
of the report."""

_WIDTH: Final = 22


def add_arguments(parser: argparse.ArgumentParser, command: str) -> None:
    arguments.add_json(parser)
    arguments.add_endpoint(parser)


def run(args: argparse.Namespace) -> int:
    """Examine this machine and print the report. Return the exit code."""
    where = args.endpoint or arbiter_endpoint(os.environ, os.getuid())
    machine = this_machine(where, ask_nvml())
    report = Report(where, examine(machine, CHECKS))
    if args.as_json:
        print(json.dumps(to_map(report), indent=2))
    else:
        print("\n".join(lines_of(report, width=terminal.columns())))
    if machine.arbiter.problem is not None:
        return UNREACHABLE
    return NO if any(one.severity in WRONG for one in report.findings) else OK


def lines_of(report: Report, *, width: int | None = None) -> list[str]:
    """Return the report as lines: severity, code, what was found; below it what fixes it.

    `width`: columns to which findings are folded; commands stay in one line.
    """
    lines, indent = [printable(f"examined for {report.endpoint}")], 9 + _WIDTH + 1
    for one in report.findings:
        mark = f"{one.severity.upper() if one.severity in WRONG else one.severity:<8}"
        line = f"{mark} {one.code:<{_WIDTH}} {printable(one.found)}"
        lines += terminal.folded(line, indent, width)
        if one.fix and one.severity is not Severity.OK:
            lines.append(f"{'':<{9 + _WIDTH}} → {printable(one.fix)}")
    counts = Counter(one.severity for one in report.findings)
    said = ", ".join(f"{counts[one]} {one}" for one in Severity if counts[one])
    return [*lines, said]
