"""Results of a self-test as lines of a terminal, as JSON, and as Markdown for an issue."""

import json
import platform
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from importlib.metadata import PackageNotFoundError, version
from typing import Final

from vram_arbiter.clients.calibration.gpu import Gpu
from vram_arbiter.clients.selftest.run import Outcome, Verdict
from vram_arbiter.schemas.plain import JsonMap
from vram_arbiter.schemas.runtime.printable import printable
from vram_arbiter.schemas.sizes import format_bytes

MARKS: Final[Mapping[Verdict, str]] = {"pass": "✓", "miss": "✗", "failed": "✗", "skipped": "–"}
SIMULATED: Final = "SIMULATED GPU: the programs are tested, no claim about hardware is"
PACKAGES: Final = ("vram-arbiter", "torch", "transformers", "lerobot", "bitsandbytes")


def line_of(result: Outcome, *, simulated: bool) -> str:
    """Return a result as one line. A mark in brackets is of a simulated GPU."""
    passed, mark = result.verdict == "pass", MARKS[result.verdict]
    mark = f"({mark})" if simulated and passed else f" {mark} "
    remark = result.remark if passed else f"{result.verdict}: {result.remark}"
    return printable(f"{mark} {result.id:<14}{_figure(result):>14}  {result.limit:<16}  {remark}")


def _figure(result: Outcome) -> str:
    if result.figure is None:
        return ""
    form = ".0f" if abs(result.figure) >= 100 else ".3g"
    return f"{result.figure:{form}} {result.unit}".rstrip()


def summary_of(results: Sequence[Outcome], *, simulated: bool) -> str:
    """Return the number of rows by verdict."""
    counts = Counter(one.verdict for one in results)
    said = ", ".join(f"{counts[one]} {one}" for one in MARKS if counts[one])
    return f"{said} ({SIMULATED})" if simulated else said


def told(gpu: Gpu, results: Sequence[Outcome], *, simulated: bool) -> JsonMap:
    """Return machine and rows as a map; nothing in it names the machine or a user."""
    machine = {
        "gpu": gpu.name, "memory": format_bytes(gpu.total_bytes), "driver": gpu.driver,
        "kernel": platform.release(), "python": platform.python_version(),
    } | {name: found for name in PACKAGES if (found := _version(name))}  # fmt: skip
    rows = [asdict(one) for one in results]
    summary = summary_of(results, simulated=simulated)
    return {"summary": summary, "simulated": simulated, "machine": machine, "rows": rows}


def _version(package: str) -> str:
    try:
        return version(package)
    except PackageNotFoundError:
        return ""


def as_json(told: JsonMap) -> str:
    return json.dumps(told, indent=2) + "\n"


def as_markdown(told: JsonMap) -> str:
    """Return the map of `told` as text for an issue."""
    lines = [f"## vramctl selftest: {told['summary']}", ""]
    lines += [f"- {name}: {value}" for name, value in told["machine"].items()]
    columns = [name for name in told["rows"][0] if name != "seconds"]
    lines += ["", f"| {' | '.join(columns)} |", "| --- " * len(columns) + "|"]
    for one in told["rows"]:
        cells = ["" if one[name] is None else str(one[name]) for name in columns]
        lines.append(f"| {' | '.join(printable(cell).replace('|', '/') for cell in cells)} |")
    return "\n".join(lines) + "\n"
