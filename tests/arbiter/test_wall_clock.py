"""The wall clock jumps: a battery is missing, the network sets it, somebody types a date. So
nothing may be decided by it.

Whoever reads it in the arbiter is listed here with what it is good for; everything else runs on the
monotonic clock.
"""

import ast
from pathlib import Path

ARBITER = Path(__file__).parents[2] / "arbiter"
READERS = {
    "host/history.py": "dates of events, and which events of earlier runs are old",
    "host/seal.py": "the epoch, which grows past every known one whatever it says",
    "eventlog/writer.py": "dates in the event log",
    "eventlog/logfile.py": "names of its files",
    "eventlog/text.py": "dates for people",
    "log.py": "dates for people",
}
WALL = {
    "time",
    "time_ns",
    "localtime",
    "gmtime",
    "ctime",
    "asctime",
    "strftime",
    "CLOCK_REALTIME",
    "CLOCK_TAI",
}


def wall_clocks(tree: ast.AST) -> list[str]:
    """`time.time`, `time.localtime` …, and everything of `datetime`."""
    found = []
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute) and isinstance(node.value, ast.Name):
            if node.value.id == "time" and node.attr in WALL:
                found.append(f"time.{node.attr}")
        elif isinstance(node, ast.ImportFrom) and node.module in ("time", "datetime"):
            found += [f"from {node.module} import {alias.name}" for alias in node.names]
        elif isinstance(node, ast.Import):
            found += [alias.name for alias in node.names if alias.name == "datetime"]
    return found


def test_only_those_read_it_who_date_things() -> None:
    readers = {
        str(path.relative_to(ARBITER))
        for path in sorted(ARBITER.rglob("*.py"))
        if "testing" not in path.parts and wall_clocks(ast.parse(path.read_text(encoding="utf-8")))
    }
    assert readers == set(READERS)


def test_the_search_finds_what_it_is_for() -> None:
    text = (
        "import time, datetime\nfrom time import time as now\nx = time.time()\ny = "
        "time.monotonic()\n"
    )
    assert wall_clocks(ast.parse(text)) == ["datetime", "from time import time", "time.time"]
