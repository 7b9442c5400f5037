"""Independent checker of a simulated GPU's allocation log: proves afterwards that no instant
exceeded the capacity.

It reads the JSON lines by itself and shares no code with `schemas.fakegpu`, whose mistakes it is
there to find. Run it with `python -m tests.support.fakegpu_check FOLDER`.
"""

import json
import sys
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

_OPS = {"context", "alloc", "cache", "free", "leak", "returned", "oom", "died", "edited"}


@dataclass(slots=True)
class Report:
    """What a log shows. `problems` empty: the GPU was never over capacity and every byte is
    accounted for."""

    lines: int = 0
    torn_lines: int = 0
    peak_bytes: int = 0
    capacity_bytes: int = 0
    oom_events: int = 0
    processes: int = 0
    problems: list[str] = field(default_factory=list)


def check_log(text: str) -> Report:
    """Replay a log line by line.

    Rules: numbers rise by one, time never runs back; the sum of all deltas is what each line says
    is used; it stays within the capacity; no process goes below zero, grows after its death, or is
    refused what would have fitted. What somebody wrote into the folder by hand (`edited`: a test's
    stowaway) counts for the GPU, and cannot be told apart from a process's own bytes.
    """
    report = Report()
    held: dict[tuple[int, int], int] = {}
    dead: set[tuple[int, int]] = set()
    used, seq, clock, by_hand = 0, 0, float("-inf"), 0
    pieces = text.split("\n")
    if pieces[-1]:
        report.torn_lines += 1  # nobody came after the process that was killed while it wrote
    for number, piece in enumerate(pieces[:-1], 1):
        line = _parse(piece)
        if line is None:
            report.torn_lines += 1
            continue

        def bad(problem: str, at: int = number, story: dict[str, Any] = line) -> None:
            report.problems.append(f"line {at}: {problem}: {story}")

        report.lines += 1
        key, op, delta = (line["pid"], line["start"]), line["op"], line["delta"]
        if line["seq"] != seq + 1:
            bad(f"number {line['seq']} follows {seq}")
        if line["t"] < clock:
            bad("time runs back")
        seq, clock = line["seq"], line["t"]
        used += delta
        held[key] = held.get(key, 0) + delta
        report.capacity_bytes = line["capacity"]
        report.peak_bytes = max(report.peak_bytes, used)
        if op not in _OPS:
            bad(f"unknown op {op}")
        if used > line["capacity"]:
            bad(f"{used} bytes on a GPU of {line['capacity']}")
        if used != line["used_after"]:
            bad(f"the deltas sum up to {used}, not to {line['used_after']}")
        by_hand += abs(delta) if op == "edited" else 0
        if op != "edited" and (
            abs(held[key] - line["process_bytes"]) > by_hand or line["process_bytes"] < 0
        ):
            bad(f"the process has {held[key]} bytes")
        if op in ("context", "alloc") and key in dead:
            bad("a dead process grows")
        if (delta > 0 and op not in ("context", "alloc", "edited")) or (
            delta < 0 and op not in ("returned", "edited")
        ):
            bad(f"{op} must not change the GPU by {delta}")
        if op == "died":
            dead.add(key)
        if op == "oom":
            report.oom_events += 1
            if line["bytes"] <= line["capacity"] - used:
                bad("refused although it fitted")
    report.processes = len(held)
    return report


def _parse(piece: str) -> dict[str, Any] | None:
    try:
        line = json.loads(piece)
    except ValueError:
        return None
    return line if isinstance(line, dict) else None


def main() -> int:
    """Print the report; 1 if there are problems."""
    if len(sys.argv) != 2:
        print("usage: python -m tests.support.fakegpu_check FOLDER", file=sys.stderr)
        return 2
    report = check_log((Path(sys.argv[1]) / "log.jsonl").read_text(errors="replace"))
    for problem in report.problems:
        print(problem)
    print(
        f"{report.lines} changes by {report.processes} processes, peak {report.peak_bytes} of "
        f"{report.capacity_bytes} bytes, "
        f"{report.oom_events} refused, {report.torn_lines} torn lines, {len(report.problems)} "
        "problems"
    )
    return 1 if report.problems else 0


if __name__ == "__main__":
    sys.exit(main())
